"""How frames of films are asked for and waited for. What a GPU makes of it is tested there, in test_gpu.py."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.hand_made import looking_at, round_gaussians

from drivesplat.errors import ResultError
from drivesplat.kernels import capacity as rooms
from drivesplat.kernels import triton as on_gpu
from drivesplat.kernels.cuda_graphs import Graph
from drivesplat.model.splat_model import SplatModel
from drivesplat.rendering import captured_frames as frames_on_gpu
from drivesplat.rendering.captured_frames import Asked, Frame, FramesOnGpu
from drivesplat.rendering.frames import _in_a_row

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


# ---- what is captured, and when it is captured anew


RENDERED, REPLAYED = 0, 1


class Film:
    """A model whose one list needs as many entries as a view's time says, on a GPU that it stands for: `captured` are
    the needs that were told of each graph; a `full` GPU cannot replay."""

    def __init__(self, monkeypatch):
        self.captured: list[list[int]] = []
        self.full = False
        self.model = SplatModel([round_gaussians([[0.0, 0.0, 0.0]])], None)
        monkeypatch.setattr(on_gpu, "compiles", lambda: True)
        monkeypatch.setattr(rooms, "LEAST", 0)
        monkeypatch.setattr(torch.cuda, "Event", lambda: SimpleNamespace(record=int, synchronize=int))
        monkeypatch.setattr(torch.cuda, "empty_cache", int)
        monkeypatch.setattr(frames_on_gpu, "_frame", self.rendered)
        monkeypatch.setattr(frames_on_gpu, "_to_host", torch.clone)
        monkeypatch.setattr(frames_on_gpu._FrameGraph, "of", self.capture)
        self.frames = FramesOnGpu(self.model)

    def rendered(self, model, view, gaussians):
        rooms.room_for(torch.tensor(int(view.time)))
        return Frame(torch.full((1, 1, 3), RENDERED, dtype=torch.uint8), torch.tensor(True))

    def capture(self, model, view, moments, needs):
        self.captured.append(list(needs))
        return frames_on_gpu._FrameGraph(view, moments, Replaying(self, [int(rooms.MARGIN * need) for need in needs]))

    def shown(self, *views) -> list[int]:
        """Of each view, or view with Gaussians of its own, whether it was rendered or replayed."""
        pairs = [view if isinstance(view, tuple) else (view, None) for view in views]
        return [int(frame[0, 0, 0]) for frame in _in_a_row(self.frames.asked, pairs)]


class Replaying(Graph):
    """A graph that replays nothing."""

    def __init__(self, film: Film, room: list[int]):
        pixels = torch.full((1, 1, 3), REPLAYED, dtype=torch.uint8)
        super().__init__(int, Frame(pixels, torch.tensor(True)), torch.tensor([0]), room, torch.tensor(0))
        self.__dict__["film"] = film


@pytest.fixture
def film(monkeypatch) -> Film:
    def replayed(self, view, moments):
        if self.graph.film.full:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        self.graph.needed[0] = int(view.time)
        return self.graph

    monkeypatch.setattr(frames_on_gpu._FrameGraph, "replayed", replayed)
    return Film(monkeypatch)


def needing(entries: int):
    return looking_at([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], time=float(entries))


def test_all_frames_but_the_first_are_one_that_is_replayed(film):
    assert film.shown(*map(needing, (100, 90, 150, 100))) == [RENDERED] + [REPLAYED] * 3
    assert film.captured == [[100]]


def test_a_film_that_outgrows_its_room_is_captured_anew_once(film):
    """Not for the frame that was on its way meanwhile, which needs a little more."""
    assert film.shown(*map(needing, (100, 100, 160, 161, 162, 240, 163))) == [
        RENDERED, REPLAYED, RENDERED, RENDERED, REPLAYED, REPLAYED, REPLAYED
    ]  # fmt: skip
    assert film.captured == [[100], [160]]


def test_what_is_captured_is_of_one_size(film):
    wider = replace(needing(100), width=needing(100).width + 1)
    assert film.shown(needing(100), needing(100), wider, needing(100)) == [RENDERED] + [REPLAYED] * 3
    assert len(film.captured) == 3


def test_gaussians_of_their_own_and_cameras_of_the_rig_are_rendered(film):
    """Where those were, and how they expose, is Python's to know."""
    of_rig, edited = replace(needing(100), camera="CAM_BACK"), (needing(100), film.model.gaussians_at(0.0))
    assert film.shown(needing(100), of_rig, edited, of_rig) == [RENDERED] * 4 and not film.captured
    assert film.shown(needing(100), edited, needing(100)) == [REPLAYED, RENDERED, REPLAYED]


def test_a_model_without_moments_is_rendered(film, monkeypatch):
    monkeypatch.setattr(film.model, "moments", lambda time: None)
    assert film.shown(*[needing(100)] * 3) == [RENDERED] * 3 and not film.captured


def test_where_capturing_is_refused_it_is_not_tried_again(film, monkeypatch):
    tried = []
    monkeypatch.setattr(frames_on_gpu._FrameGraph, "of", lambda *told: tried.append(told))
    assert film.shown(*[needing(100)] * 4) == [RENDERED] * 4 and len(tried) == 1


def test_without_memory_for_both_what_is_captured_goes(film):
    assert film.shown(*[needing(100)] * 2) == [RENDERED, REPLAYED]
    film.full = True
    assert film.shown(*[needing(100)] * 2) == [RENDERED] * 2
    film.full = False
    assert film.shown(*[needing(100)] * 2) == [RENDERED] * 2 and len(film.captured) == 1
