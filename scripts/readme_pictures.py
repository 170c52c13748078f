"""Pictures of the documentation, composed from films of benchmarks/film.yaml: drive.webp, the README's moving
picture, and ghosts.webp of docs/ghosts.md.

python scripts/readme_pictures.py [results/film/demo] [docs/images]
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg
from PIL import Image, ImageDraw, ImageFont

FILM_HZ = 12
"""Images a second of the films."""
MOVING, STILL = range(36, 96), 62
"""The images of the films that the moving picture and the still one show."""
PANEL, GAP, LABEL = (480, 270), 4, 22
"""Width and height of a panel, pixels between the panels, and the height of the line above each."""


def images(film: Path, chosen: Sequence[int]) -> list[Image.Image]:
    """Some images of a film."""
    frames = imageio_ffmpeg.read_frames(str(film))
    size = next(frames)["size"]
    return [Image.frombytes("RGB", size, frame) for number, frame in enumerate(frames) if number in chosen]


def quarter(image: Image.Image, column: int, row: int) -> Image.Image:
    width, height = image.width // 2, image.height // 2
    return image.crop((column * width, row * height, (column + 1) * width, (row + 1) * height))


def composed(panels: dict[str, Image.Image]) -> Image.Image:
    """Four panels in two rows, each below its label."""
    picture = Image.new("RGB", (2 * PANEL[0] + GAP, 2 * (PANEL[1] + LABEL) + GAP), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    for number, (label, panel) in enumerate(panels.items()):
        x, y = number % 2 * (PANEL[0] + GAP), number // 2 * (PANEL[1] + LABEL + GAP)
        draw.text((x + 2, y + 1), label, fill="black", font=font)
        picture.paste(panel.resize(PANEL, Image.Resampling.LANCZOS), (x, y + LABEL))
    return picture


def moving_picture(results: Path) -> list[Image.Image]:
    quads = images(results / "street_people/quad/two_oncoming.mp4", MOVING)
    return [
        composed(
            {
                "recorded": quarter(quad, 0, 0),
                "vanilla 3D Gaussians: moving cars become ghosts": vanilla,
                "drivesplat: every actor has its own Gaussians": quarter(quad, 0, 1),
                "edited: a second oncoming car, in red": quarter(quad, 1, 1),
            }
        )
        for quad, vanilla in zip(quads, images(results / "vanilla/original.mp4", MOVING), strict=True)
    ]


def still_picture(results: Path) -> Image.Image:
    films = "vanilla/original", "street_people/quad/two_oncoming", "vanilla/lateral_2m", "street_people/lateral_2m"
    vanilla, quad, *aside = (images(results / f"{film}.mp4", [STILL])[0] for film in films)
    labels = "vanilla, on the path", "street, on the path", "vanilla, 2 m to the left", "street, 2 m to the left"
    return composed(dict(zip(labels, (vanilla, quarter(quad, 0, 1), *aside), strict=True)))


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("results", nargs="?", type=Path, default=Path("results/film/demo"))
    arguments.add_argument("folder", nargs="?", type=Path, default=Path("docs/images"))
    given = arguments.parse_args()
    first, *others = moving_picture(given.results)
    moving = {"save_all": True, "append_images": others, "duration": 1000 // FILM_HZ, "loop": 0}
    first.save(given.folder / "drive.webp", quality=42, method=4, **moving)
    still_picture(given.results).save(given.folder / "ghosts.webp", quality=75, method=6)
