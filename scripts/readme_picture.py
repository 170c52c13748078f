"""docs/images/drive.webp, the README's moving picture, composed from films of benchmarks/worlds/film.yaml.

python scripts/readme_picture.py [results/film/demo] [docs/images/drive.webp]
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import imageio_ffmpeg
from PIL import Image, ImageDraw, ImageFont

FILM_HZ, EVERY = 12, 1
"""Images a second of the films, and which of them the picture shows."""
SECONDS = 3.0, 8.0
PANEL, GAP, LABEL = (480, 270), 4, 22
"""Width and height of a panel, pixels between the panels, and the height of the line above each."""
LABELS = (
    "recorded",
    "vanilla 3D Gaussians: moving cars become ghosts",
    "drivesplat: every actor has its own Gaussians",
    "edited: a second oncoming car, in red",
)


def images(film: Path) -> Iterator[Image.Image]:
    """The images of a film that the picture shows."""
    frames = imageio_ffmpeg.read_frames(str(film))
    size = next(frames)["size"]
    first, last = (round(second * FILM_HZ) for second in SECONDS)
    yield from (Image.frombytes("RGB", size, frame) for i, frame in enumerate(frames) if i in range(first, last, EVERY))


def composed(quad: Image.Image, vanilla: Image.Image) -> Image.Image:
    """The recorded image, both methods and the edit, each below its label, from an image of each film."""
    width, height = quad.width // 2, quad.height // 2
    recorded, street, edited = (
        quad.crop((column * width, row * height, (column + 1) * width, (row + 1) * height))
        for column, row in ((0, 0), (0, 1), (1, 1))
    )
    picture = Image.new("RGB", (2 * PANEL[0] + GAP, 2 * (PANEL[1] + LABEL) + GAP), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    for number, (label, panel) in enumerate(zip(LABELS, (recorded, vanilla, street, edited), strict=True)):
        x, y = number % 2 * (PANEL[0] + GAP), number // 2 * (PANEL[1] + LABEL + GAP)
        draw.text((x + 2, y + 1), label, fill="black", font=font)
        picture.paste(panel.resize(PANEL, Image.Resampling.LANCZOS), (x, y + LABEL))
    return picture


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("results", nargs="?", type=Path, default=Path("results/film/demo"))
    arguments.add_argument("picture", nargs="?", type=Path, default=Path("docs/images/drive.webp"))
    given = arguments.parse_args()
    films = given.results / "street_people/quad/two_oncoming.mp4", given.results / "vanilla/original.mp4"
    first, *others = (composed(*both) for both in zip(*map(images, films), strict=True))
    first.save(
        given.picture,
        save_all=True,
        append_images=others,
        duration=1000 * EVERY // FILM_HZ,
        loop=0,
        quality=42,
        method=4,
    )
