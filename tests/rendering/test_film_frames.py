"""How frames of films are submitted and waited for. test_gpu.py tests their rendering on a GPU."""

from dataclasses import dataclass, field

import numpy as np
import pytest
import torch

from drivesplat.errors import ResultError
from drivesplat.rendering.frames import PendingFrame, _pipelined

CAPACITY = 7


@dataclass
class FakeGpu:
    """A device that renders numbers as pixels and logs calls. `spoilt` frames, once: whether they are finite, and the
    number of entries that the second of their two lists needs."""

    spoilt: dict[int, tuple[bool, int]] = field(default_factory=dict)
    log: list[str] = field(default_factory=list)

    def submit(self, number: int, again: bool = False) -> PendingFrame:
        self.log.append(f"submit {number}")
        finite, needed = self.spoilt.pop(number, (True, CAPACITY))
        pixels = torch.full((1, 1, 3), 100 * again + number, dtype=torch.uint8)
        return PendingFrame(
            pixels,
            torch.tensor(finite),
            torch.tensor([1, needed], dtype=torch.int32),
            [CAPACITY, CAPACITY],
            lambda: self.log.append(f"wait {number}"),
            lambda: self.submit(number, again=True),
        )


def frames(gpu: FakeGpu, count: int) -> list[int]:
    return [int(frame[0, 0, 0]) for frame in _pipelined(gpu.submit, range(count))]


def test_a_frame_is_submitted_before_the_one_before_it_is_waited_for():
    gpu = FakeGpu()
    assert frames(gpu, 3) == [0, 1, 2]
    assert gpu.log == ["submit 0", "submit 1", "wait 0", "submit 2", "wait 1", "wait 2"]
    assert frames(FakeGpu(), 1) == [0] and frames(FakeGpu(), 0) == []


def test_a_frame_whose_lists_overflowed_is_rendered_again_and_one_with_nan_an_error_at_its_turn():
    assert frames(FakeGpu({1: (True, CAPACITY + 1), 2: (False, CAPACITY + 1)}), 4) == [0, 101, 102, 3]
    frames_of_film = _pipelined(FakeGpu({1: (False, CAPACITY)}).submit, range(3))
    np.testing.assert_array_equal(next(frames_of_film), np.zeros((1, 1, 3)))
    with pytest.raises(ResultError, match="NaN or Inf"):
        next(frames_of_film)
