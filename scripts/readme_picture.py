"""docs/images/demo.png, the README's picture, composed from the results of a finished demo.

python scripts/readme_picture.py [results/demo] [docs/images/demo.png]
"""

import argparse
from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

GAP, LABEL = 8, 22
"""Pixels between the panels, and of the line above each."""


def panels(results: Path) -> list[tuple[str, Image.Image]]:
    """The four panels with their labels: one held-out image, recorded and by both methods, and the still of an edit."""
    edit = Image.open(results / "street/edits/beside_and_slower.png")
    return [
        ("Held-out image, recorded", Image.open(results / "vanilla/held_out_recorded.png")),
        ("vanilla: the moving car is a ghost", Image.open(results / "vanilla/held_out_rendered.png")),
        ("street: the car has Gaussians of its own", Image.open(results / "street/held_out_rendered.png")),
        ("street, edited: the camera drives 1 m to the left", edit.crop((edit.width // 2, 0, edit.width, edit.height))),
    ]


def composed(pictures: list[tuple[str, Image.Image]]) -> Image.Image:
    """The panels in two rows, each below its label, with 256 colours."""
    width, height = pictures[0][1].size
    picture = Image.new("RGB", (2 * width + GAP, 2 * (height + LABEL) + GAP), "white")
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(15)
    for number, (label, panel) in enumerate(pictures):
        x, y = number % 2 * (width + GAP), number // 2 * (height + LABEL + GAP)
        draw.text((x + 2, y + 1), label, fill="black", font=font)
        picture.paste(panel, (x, y + LABEL))
    return picture.quantize(256, kmeans=3)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    arguments.add_argument("results", nargs="?", type=Path, default=Path("results/demo"))
    arguments.add_argument("picture", nargs="?", type=Path, default=Path("docs/images/demo.png"))
    given = arguments.parse_args()
    composed(panels(given.results)).save(given.picture, optimize=True)
