"""How frames of films are submitted and waited for. test_gpu.py tests their rendering on a GPU."""

from dataclasses import dataclass, field, replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from helpers.hand_made import looking_at, round_gaussians

from drivesplat.errors import ResultError
from drivesplat.kernels import capacity, triton_support
from drivesplat.kernels.cuda_graphs import CudaGraph
from drivesplat.model.splat_model import SplatModel
from drivesplat.rendering import captured_frames
from drivesplat.rendering.captured_frames import GpuFrameRenderer, PendingFrame, RenderedFrame
from drivesplat.rendering.frames import _pipelined

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
            RenderedFrame(pixels, torch.tensor(finite)),
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


# ---- what is captured, and when it is captured anew


RENDERED, REPLAYED = 0, 1


class Film:
    """A model on a fake GPU whose one list needs as many entries as a view's time says. `captured` are the entries that
    each graph was captured with; a `full` GPU cannot replay."""

    def __init__(self, monkeypatch):
        self.captured: list[list[int]] = []
        self.full = False
        self.model = SplatModel([round_gaussians([[0.0, 0.0, 0.0]])], None)
        monkeypatch.setattr(triton_support, "compiles", lambda: True)
        monkeypatch.setattr(capacity, "MIN_CAPACITY", 0)
        monkeypatch.setattr(torch.cuda, "Event", lambda: SimpleNamespace(record=int, synchronize=int))
        monkeypatch.setattr(torch.cuda, "empty_cache", int)
        monkeypatch.setattr(captured_frames, "_render", self.rendered)
        monkeypatch.setattr(captured_frames, "_to_host", torch.clone)
        monkeypatch.setattr(captured_frames._FrameGraph, "capture", self.capture)
        self.renderer = GpuFrameRenderer(self.model)

    def rendered(self, model, view, gaussians):
        capacity.capacity_for(torch.tensor(int(view.time)))
        return RenderedFrame(torch.full((1, 1, 3), RENDERED, dtype=torch.uint8), torch.tensor(True))

    def capture(self, model, view, states, needs):
        self.captured.append(list(needs))
        graph = Replaying(self, [int(capacity.MARGIN * need) for need in needs])
        return captured_frames._FrameGraph(view, states, graph)

    def made(self, *views) -> list[int]:
        """For each view, or view with Gaussians of its own, whether it was RENDERED or REPLAYED."""
        pairs = [view if isinstance(view, tuple) else (view, None) for view in views]
        return [int(frame[0, 0, 0]) for frame in _pipelined(self.renderer.submit, pairs)]


class Replaying(CudaGraph):
    """A graph that replays nothing."""

    def __init__(self, film: Film, room: list[int]):
        pixels = torch.full((1, 1, 3), REPLAYED, dtype=torch.uint8)
        super().__init__(int, RenderedFrame(pixels, torch.tensor(True)), torch.tensor([0]), room, torch.tensor([0]))
        self.__dict__["film"] = film


@pytest.fixture
def film(monkeypatch) -> Film:
    def replay(self, view, states):
        if self.graph.film.full:
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        self.graph.needed[0] = int(view.time)
        return self.graph

    monkeypatch.setattr(captured_frames._FrameGraph, "replay", replay)
    return Film(monkeypatch)


def needing(entries: int):
    return looking_at([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], time=float(entries))


def test_all_frames_of_an_image_size_but_the_first_replay_one_graph(film):
    assert film.made(*map(needing, (100, 90, 150, 100))) == [RENDERED] + [REPLAYED] * 3
    assert film.captured == [[100]]
    wider = replace(needing(100), width=needing(100).width + 1)
    assert film.made(needing(100), wider, needing(100)) == [REPLAYED] * 3
    assert len(film.captured) == 3


def test_a_film_whose_lists_overflow_is_captured_anew_once(film):
    """Not for the pending frame, which needs a little more."""
    assert film.made(*map(needing, (100, 100, 160, 161, 162, 240, 163))) == [
        RENDERED, REPLAYED, RENDERED, RENDERED, REPLAYED, REPLAYED, REPLAYED
    ]  # fmt: skip
    assert film.captured == [[100], [160]]


def test_frames_with_own_gaussians_or_of_a_rig_camera_are_not_captured(film):
    """Python looks up the poses and exposures of cameras of the rig."""
    of_rig, edited = replace(needing(100), camera="CAM_BACK"), (needing(100), film.model.at(0.0))
    assert film.made(needing(100), of_rig, edited, of_rig) == [RENDERED] * 4 and not film.captured
    assert film.made(needing(100), edited, needing(100)) == [REPLAYED, RENDERED, REPLAYED]


def test_a_refused_capture_is_not_tried_again(film, monkeypatch):
    tried = []
    monkeypatch.setattr(captured_frames._FrameGraph, "capture", lambda *arguments: tried.append(arguments))
    assert film.made(*[needing(100)] * 4) == [RENDERED] * 4 and len(tried) == 1


def test_the_graph_is_dropped_when_memory_runs_out(film):
    assert film.made(*[needing(100)] * 2) == [RENDERED, REPLAYED]
    film.full = True
    assert film.made(*[needing(100)] * 2) == [RENDERED] * 2
    film.full = False
    assert film.made(*[needing(100)] * 2) == [RENDERED] * 2 and len(film.captured) == 1
