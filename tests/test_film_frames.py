"""How frames of films are asked for and waited for. What a GPU makes of it is tested there, in test_gpu.py."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from drivesplat.errors import ResultError
from drivesplat.frames import _in_a_row
from drivesplat.on_gpu.frames import Asked, Frame

ROOM = 7


@dataclass
class Card:
    """A device that renders numbers as pixels, and remembers what happened when. `spoilt` frames, once: whether they
    are numbers, and how many entries the second of their two lists needs."""

    spoilt: dict[int, tuple[bool, int]] = field(default_factory=dict)
    done: list[str] = field(default_factory=list)

    def ask(self, number: int, again: bool = False) -> Asked:
        self.done.append(f"ask {number}")
        finite, needed = self.spoilt.pop(number, (True, ROOM))
        pixels = torch.full((1, 1, 3), 100 * again + number, dtype=torch.uint8)
        return Asked(
            Frame(pixels, torch.tensor(finite)),
            torch.tensor([1, needed], dtype=torch.int32),
            [ROOM, ROOM],
            lambda: self.done.append(f"wait {number}"),
            lambda: self.ask(number, again=True),
        )


def frames(card: Card, count: int) -> list[int]:
    return [int(frame[0, 0, 0]) for frame in _in_a_row(card.ask, range(count))]


def test_a_frame_is_asked_for_before_the_one_before_it_is_waited_for():
    card = Card()
    assert frames(card, 3) == [0, 1, 2]
    assert card.done == ["ask 0", "ask 1", "wait 0", "ask 2", "wait 1", "wait 2"]
    assert frames(Card(), 1) == [0] and frames(Card(), 0) == []


def test_a_frame_whose_lists_had_too_little_room_is_asked_for_again():
    assert frames(Card({1: (True, ROOM + 1), 2: (False, ROOM + 1)}), 4) == [0, 101, 102, 3]


def test_a_frame_that_is_no_numbers_is_told_when_it_is_its_turn():
    shown = _in_a_row(Card({1: (False, ROOM)}).ask, range(3))
    np.testing.assert_array_equal(next(shown), np.zeros((1, 1, 3)))
    with pytest.raises(ResultError, match="no numbers"):
        next(shown)
