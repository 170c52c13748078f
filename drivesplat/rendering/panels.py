"""Films of several pictures of one size: panels in rows, all at full size."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

MAX_WIDTH = 4096
"""Pixels; browsers decode wider H.264 films slowly or not at all."""
MAX_IN_ONE_ROW = 3


@dataclass(frozen=True)
class Panels:
    """Panels with these `labels`, each `size` (width and height in pixels, even), from the top left row by row."""

    labels: tuple[str, ...]
    size: tuple[int, int]

    @property
    def columns(self) -> int:
        """One row of up to MAX_IN_ONE_ROW panels, otherwise as many rows as columns; fewer columns where the film would
        be wider than MAX_WIDTH."""
        count = len(self.labels)
        wanted = count if count <= MAX_IN_ONE_ROW else math.ceil(math.sqrt(count))
        return max(1, min(wanted, MAX_WIDTH // self.size[0]))

    @property
    def film_size(self) -> tuple[int, int]:
        """Width and height of the film in pixels."""
        return self.columns * self.size[0], math.ceil(len(self.labels) / self.columns) * self.size[1]

    def corner(self, number: int) -> tuple[int, int]:
        """The left and top edge of a panel in the film (pixels)."""
        row, column = divmod(number, self.columns)
        return column * self.size[0], row * self.size[1]

    def inside(self, picture: np.ndarray, number: int) -> np.ndarray:
        """The view of a panel in a picture (h, w, ...) of the film."""
        left, top = self.corner(number)
        return picture[top : top + self.size[1], left : left + self.size[0]]

    def assembled(self, pictures: Sequence[np.ndarray]) -> np.ndarray:
        """A picture of the film (h, w, 3) uint8 from one for each panel; places without a panel are black."""
        if len(pictures) == 1:
            return pictures[0]
        width, height = self.film_size
        film = np.zeros((height, width, 3), np.uint8)
        for number, picture in enumerate(pictures):
            self.inside(film, number)[:] = picture
        return film

    def record(self) -> dict[str, Any]:
        """The film's size and the place of each panel in it, in pixels, for other programs."""
        width, height = self.film_size
        corners = [self.corner(number) for number in range(len(self.labels))]
        places = [{"shows": label, "left": x, "top": y} for label, (x, y) in zip(self.labels, corners, strict=True)]
        return {"width": width, "height": height, "panels": places}
