"""When graphs of iterations are captured, replayed and dropped. test_gpu.py tests what a graph does, on a GPU."""

import dataclasses
from functools import partial

import pytest
import torch
from helpers.trainings import guided_views

from drivesplat.kernels import triton_support
from drivesplat.kernels.capacity import capacity_for
from drivesplat.kernels.cuda_graphs import CudaGraph
from drivesplat.settings.train import TrainSettings
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.graphs import iteration_graphs
from drivesplat.training.graphs.iteration_graphs import GaussianCount, IterationGraphs, Recording, can_capture
from drivesplat.training.schedule import Schedule
from drivesplat.training.views import TrainingView

CPU = torch.device("cpu")
HUNDRED = GaussianCount(100, 1.0)


class FakeGraphs:
    """IterationGraphs whose graphs log what they do in place of doing it."""

    def __init__(self, monkeypatch):
        self.log, self.capacities, self.needed = [], [], 3000
        self.graphs = IterationGraphs(True, CPU)
        monkeypatch.setattr(IterationGraphs, "_capture", lambda _, *arguments: self.capture(*arguments))
        monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)

    def capture(self, recording, gaussians, iteration):
        image = recording.index
        self.log.append(("captured", image))
        self.capacities.append([need * gaussians for need in self.graphs._needs[recording]])
        replay, needed = partial(self.log.append, ("replayed", image)), torch.tensor([self.needed], dtype=torch.int32)
        self.graphs._graphs[recording] = CudaGraph(
            replay, {"l1": torch.tensor(float(image))}, needed, [self.needed], needed.clone()
        )
        return self.graphs._graphs[recording]

    def run(self, image, layout=0, gaussians=HUNDRED, kind="image", runs=1):
        def iteration():
            self.log.append(("run", image))
            capacity_for(torch.tensor(self.needed))
            return {"l1": torch.tensor(float(image))}

        terms = self.graphs.run(Recording(kind, image, runs), layout, gaussians, iteration)
        assert float(terms["l1"]) == image
        logged = [action for action, of in self.log if of == image]
        self.log.clear()
        return logged


def test_an_image_is_captured_when_it_is_used_again(monkeypatch):
    fake = FakeGraphs(monkeypatch)
    assert fake.run(0) == ["run"], "the entries that its lists need are not known yet"
    assert fake.run(0) == ["captured", "replayed"]
    assert fake.run(1) == ["run"]
    assert fake.run(0) == ["replayed"]
    assert fake.run(1) == ["captured", "replayed"]


def test_another_layout_captures_anew(monkeypatch):
    """The entries that the lists of the image need are known by then."""
    fake = FakeGraphs(monkeypatch)
    assert [fake.run(0) for _ in range(3)] == [["run"], ["captured", "replayed"], ["replayed"]]
    assert [fake.run(0, layout=1) for _ in range(2)] == [["captured", "replayed"], ["replayed"]]


def test_another_layout_of_images_keeps_the_graphs_of_scans(monkeypatch):
    fake = FakeGraphs(monkeypatch)
    for image, kind in ((0, "image"), (0, "image"), (1, "scan"), (1, "scan")):
        fake.run(image, kind=kind)
    assert fake.run(0, layout=1) == ["captured", "replayed"]
    assert fake.run(1, kind="scan") == ["replayed"]
    assert fake.run(1, layout=1, kind="scan") == ["captured", "replayed"]


def test_capacities_leave_headroom_for_growth(monkeypatch):
    fake = FakeGraphs(monkeypatch)
    fake.run(0, gaussians=GaussianCount(100, 2.0))
    fake.run(0, gaussians=GaussianCount(120, 1.5))
    assert [round(room) for (room,) in fake.capacities] == [5400]
    fake.needed = 4200
    fake.graphs._graphs[Recording("image", 0)].most[0] = fake.needed
    fake.run(0, gaussians=GaussianCount(140, 1.2))
    fake.run(0, layout=1, gaussians=GaussianCount(200, 2.0))
    assert [round(room) for (room,) in fake.capacities] == [5400, 2 * 200 * 4200 // 140], (
        "the most entries that it has needed"
    )


def test_a_shared_graph_has_the_capacity_for_the_largest_of_several_runs(monkeypatch):
    """Also after another layout, though no replay needed as much."""
    fake, found = FakeGraphs(monkeypatch), []
    for fake.needed in (3000, 5000, 2000, 1000):
        found.append(fake.run(0, runs=3))
    assert found == [["run"]] * 3 + [["captured", "replayed"]]
    assert fake.run(0, layout=1, runs=3) == ["captured", "replayed"]
    assert [round(room) for (room,) in fake.capacities] == [5000, 4000], "a fifth less each time, if nothing needs it"


def test_invalidated_graphs_are_captured_again_while_graphs_are_enabled(monkeypatch):
    fake = FakeGraphs(monkeypatch)
    for _ in range(2):
        fake.run(0)
    assert fake.graphs.invalidate() and fake.run(0) == ["captured", "replayed"]
    fake.graphs.enabled = False
    assert not fake.graphs.invalidate() and not fake.graphs._graphs


def test_overflowed_graphs_are_captured_anew(monkeypatch):
    fake = FakeGraphs(monkeypatch)
    for image in (0, 0, 1, 1):
        fake.run(image)
    fake.graphs.check()
    assert fake.run(0) == ["replayed"]
    fake.graphs._graphs[Recording("image", 0)].most[0] = 7000
    fake.graphs.check()
    assert fake.run(0) == ["captured", "replayed"]
    assert [round(room) for (room,) in fake.capacities] == [3000, 3000, 7000]
    assert fake.run(1) == ["replayed"], "its lists did not overflow"


def test_the_memory_pool_is_released_with_the_last_graph(monkeypatch):
    """torch frees the pool then and cannot use it again."""
    fake = FakeGraphs(monkeypatch)
    fake.graphs._pool = (0, 1)
    for image in (0, 0, 1, 1):
        fake.run(image)
    fake.graphs._graphs[Recording("image", 0)].most.add_(1)
    fake.graphs.check()
    assert fake.graphs._pool == (0, 1)
    fake.graphs._graphs[Recording("image", 1)].most.add_(1)
    fake.graphs.check()
    assert fake.graphs._pool is None


def test_disabled_graphs_run_every_iteration(monkeypatch):
    fake = FakeGraphs(monkeypatch)
    fake.graphs.enabled = False
    assert [fake.run(0) for _ in range(3)] == [["run"]] * 3


def images_of(views: list[TrainingView]) -> TrainingImages:
    return TrainingImages(views, Schedule.of(TrainSettings(), len(views)), 0)


@pytest.mark.parametrize(
    ("settings", "device", "compiles", "expected"),
    [
        ({}, "cuda", True, True),
        ({}, "cpu", True, False),
        ({}, "cuda", False, False),
        ({"cuda_graphs": False}, "cuda", True, False),
        ({"strategy": "default"}, "cuda", True, False),
    ],
)
def test_which_trainings_capture_graphs(settings, device, compiles, expected, monkeypatch):
    monkeypatch.setattr(triton_support, "compiles", lambda: compiles)
    chosen = TrainSettings(**settings)
    assert can_capture(chosen, images_of(guided_views()), torch.device(device)) == expected


def test_classes_and_too_many_recordings_disable_graphs(monkeypatch):
    monkeypatch.setattr(triton_support, "compiles", lambda: True)
    views, gpu = guided_views(), torch.device("cuda")
    labelled = [dataclasses.replace(view, classes=torch.zeros_like(view.sky, dtype=torch.uint8)) for view in views]
    assert not can_capture(TrainSettings(), images_of(labelled), gpu)
    images = images_of(views)
    monkeypatch.setattr(iteration_graphs, "MAX_RECORDINGS", len(views) + 1)
    assert can_capture(TrainSettings(), images, gpu, scans=1)
    assert not can_capture(TrainSettings(), images, gpu, scans=2)


def test_graphs_are_dropped_when_memory_runs_out(monkeypatch, caplog):
    fake, full = FakeGraphs(monkeypatch), [False, True]
    for _ in range(2):
        fake.run(0)

    def work():
        if full.pop():
            raise torch.cuda.OutOfMemoryError("CUDA out of memory.")
        return "done"

    assert fake.graphs.retry_without_graphs(work) == "done" and not fake.graphs.enabled
    assert "no GPU memory is left for CUDA graphs" in caplog.text
    full[:] = [True]
    with pytest.raises(torch.cuda.OutOfMemoryError):  # there are no graphs to drop
        fake.graphs.retry_without_graphs(work)
