"""What a fixed model samples once, which images are captured as CUDA graphs, and when again. test_gpu.py tests graphs
themselves."""

from contextlib import nullcontext
from dataclasses import replace

import pytest
import torch
from helpers.hand_made import looking_at, round_gaussians
from helpers.hand_made_street import street_model
from helpers.trainings import scan_of_a_wall

from drivesplat.kernels import capacity
from drivesplat.kernels.cuda_graphs import CudaGraph
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import IMAGE, SCAN, Want
from drivesplat.model.view import RollingShutter
from drivesplat.rendering import fixed_model
from drivesplat.rendering.fixed_model import FixedModel, RenderedImage, overflowed

RENDERED, REPLAYED = 0.0, 1.0
SPREAD = (3e-4, 3e-4)


class FakeGpu:
    """A model on a fake GPU whose one list needs as many entries as a view's time says. `captured` are the entries that
    each graph was captured with, `pools` their memory, `shown` the first coordinate of what each replay showed; a
    `full` GPU cannot replay, one that `refuses` cannot capture.
    """

    def __init__(self, monkeypatch):
        self.captured: list[list[int]] = []
        self.pools: list[tuple[int, int]] = []
        self.shown: list[float] = []
        self.full = self.refuses = False
        for name, fake in (("graphs_supported", lambda _: True), ("new_pool", lambda: (len(self.captured), 0)),
                           ("capture_stream", lambda _: nullcontext()), ("capture", self.capture)):  # fmt: skip
            monkeypatch.setattr(fixed_model, name, fake)
        monkeypatch.setattr(torch.cuda, "empty_cache", int)
        monkeypatch.setattr(capacity, "MIN_CAPACITY", 0)
        monkeypatch.setattr(FixedModel, "_image", lambda _, view, sets: self.rendered(view, sets))
        self.model = FixedModel(SplatModel([round_gaussians([[0.0, 0.0, 0.0]])], None))

    def rendered(self, view, sets):
        capacity.capacity_for(torch.tensor(int(view.time)))
        return RenderedImage(torch.full((1, 1, 3), RENDERED), torch.ones(1, 1))

    def capture(self, work, needed, pool, device, what, errors):
        self.captured.append(list(needed))
        self.pools.append(pool)
        if self.refuses:
            return None
        seconds, needs, shown = work.args[0].seconds, torch.tensor([0]), work.args[1]

        def replay():
            if self.full:
                raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
            needs[0] = int(seconds)
            self.shown.append(float(shown[0].means[0, 0]))

        result = RenderedImage(torch.full((1, 1, 3), REPLAYED), torch.ones(1, 1))
        return CudaGraph(replay, result, needs, [int(capacity.MARGIN * need) for need in needed], needs)

    def made(self, *views) -> list[float]:
        """For each view, or view with Gaussians, whether it was RENDERED or REPLAYED."""
        pairs = [view if isinstance(view, tuple) else (view, self.model.sample_in(view)) for view in views]
        return [float(self.model.render(*pair).image[0, 0, 0]) for pair in pairs]


@pytest.fixture
def gpu(monkeypatch) -> FakeGpu:
    return FakeGpu(monkeypatch)


def needing(entries: int):
    return looking_at([0.0, 0.0, 0.0], [1.0, 0.0, 0.0], time=float(entries))


def test_all_images_of_a_kind_but_the_first_replay_one_graph(gpu):
    assert gpu.made(*map(needing, (100, 90, 150, 100))) == [RENDERED] + [REPLAYED] * 3
    assert gpu.captured == [[100]]


def test_every_kind_of_image_has_a_graph_of_its_own(gpu, monkeypatch):
    monkeypatch.setattr(fixed_model, "MAX_GRAPHS", 4)
    view = needing(100)
    rolling = RollingShutter(torch.tensor([0.0, 0.02, 0.0]), torch.eye(3, 4))
    kinds = [
        view,
        replace(view, width=view.width + 1),
        replace(view, camera="CAM_BACK"),
        replace(view, shutter=rolling),
    ]
    assert gpu.made(*kinds, *kinds, *reversed(kinds)) == [RENDERED] * 4 + [REPLAYED] * 8
    assert len(gpu.captured) == 4
    other = replace(view, height=view.height + 1)
    assert gpu.made(other, *kinds) == [RENDERED] + [REPLAYED] * 3 + [RENDERED], "the oldest kind was forgotten"


def test_a_rig_of_eight_cameras_with_their_exposures_has_graphs(gpu):
    rig = [replace(needing(100), camera=f"CAM_{i}") for i in range(8)]
    assert gpu.made(*rig, *rig, *rig) == [RENDERED] * 8 + [REPLAYED] * 16


def test_other_gaussians_of_the_same_number_are_of_the_same_kind(gpu):
    """Not the same as the model's own, which a graph reads where they are."""
    own = needing(100), [gpu.model.model.at(0.0)]
    more = needing(100), [gpu.model.model.at(0.0)[torch.tensor([0, 0])]]
    assert gpu.made(needing(100), own, own, more, needing(100)) == [RENDERED, RENDERED, REPLAYED, RENDERED, REPLAYED]


def test_a_replay_shows_the_gaussians_that_it_is_given(gpu):
    """Those that it was given before are not copied again."""
    a, b = (replace(one, means=one.means + shift) for one in [gpu.model.model.at(0.0)] for shift in (1.0, 2.0))
    gpu.made((needing(100), [a]))
    gpu.made(*[(needing(100), [own]) for own in (a, a, b, b, a)])
    del b
    gpu.made(*[(needing(100), [replace(a, means=a.means + shift)]) for shift in (2.0, 3.0)])
    assert gpu.shown == [1.0, 1.0, 2.0, 2.0, 1.0, 3.0, 4.0]


def test_images_whose_lists_overflow_are_rendered_again_and_captured_anew(gpu):
    assert gpu.made(*map(needing, (100, 100, 160, 161, 240))) == [RENDERED, REPLAYED, RENDERED, REPLAYED, REPLAYED]
    assert gpu.captured == [[100], [160]]


def test_graphs_share_memory_while_one_of_them_lives(gpu):
    """torch frees a pool with its last graph and refuses a capture in it afterwards."""
    smaller = [replace(needing(entries), width=8) for entries in (100, 100)]
    gpu.made(needing(100), needing(100), *smaller, needing(160), needing(160))
    assert gpu.pools == [(0, 0)] * 3
    gpu.model = FixedModel(gpu.model.model)
    gpu.made(needing(100), needing(100), needing(160), needing(160))
    assert gpu.pools[3:] == [(3, 0), (4, 0)]


def test_images_that_are_made_together_are_those_made_one_by_one(gpu):
    views = [needing(entries) for entries in (100, 90, 160, 100)]
    images = gpu.model.render_all([(view, gpu.model.sample_in(view)) for view in views])
    assert [float(own.image[0, 0, 0]) for own in images] == [RENDERED, REPLAYED, RENDERED, REPLAYED]
    assert gpu.captured == [[100]] and gpu.model.render_all([]) == []


def test_a_refused_capture_is_not_tried_again(gpu):
    gpu.refuses = True
    assert gpu.made(*[needing(100)] * 4) == [RENDERED] * 4 and len(gpu.captured) == 1


def test_graphs_are_dropped_when_memory_runs_out(gpu):
    assert gpu.made(*[needing(100)] * 2) == [RENDERED, REPLAYED]
    gpu.full = True
    assert gpu.made(*[needing(100)] * 2) == [RENDERED] * 2
    gpu.full = False
    assert gpu.made(*[needing(100)] * 2) == [RENDERED] * 2 and len(gpu.captured) == 1


def test_a_list_overflows_beyond_its_capacity():
    assert overflowed([1, 8], [7, 7]) and not overflowed([7, 0], [7, 7]) and not overflowed([], [])


def test_what_is_the_same_at_all_times_is_sampled_once():
    fixed = FixedModel(street_model())
    static, moving = fixed.sample(1.0)
    later_static, later_moving = fixed.sample(2.0)
    assert later_static is static and not torch.equal(moving.means, later_moving.means)
    assert fixed.sample(1.0, Want(velocities=True))[0] is static
    scanned = fixed.sample(1.0, SCAN)[0]
    assert scanned is not static and fixed.sample(2.0, SCAN)[0] is scanned
    for found, own in zip(fixed.sample(1.0), fixed.model.sample(fixed.model.states(1.0)), strict=True):
        assert all(torch.equal(found.tensors[name], own.tensors[name]) for name in own.tensors)
    assert fixed.sample(1.0, IMAGE)[0] is static


def test_what_follows_from_the_rays_of_a_scan_is_computed_once():
    fixed = FixedModel(street_model())
    scan = scan_of_a_wall(1.0)
    first, again = fixed.scan_view(scan, SPREAD), fixed.scan_view(replace(scan, seconds=2.0), SPREAD)
    assert again.rays is first.rays and (first.time, again.time) == (scan.seconds, 2.0)
    other = fixed.scan_view(scan_of_a_wall(1.0), SPREAD)
    assert other.rays is not first.rays and torch.equal(other.rays.azimuths, first.rays.azimuths)
    assert fixed.scan_view(scan, SPREAD).rays is first.rays
