"""When graphs of iterations are captured and dropped, and their shared inputs. test_gpu.py tests what a graph does."""

import dataclasses
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from helpers.trainings import (
    ALL_TERMS,
    CPU,
    guided_views,
    scan_of_a_wall,
    settings_of,
    untrained_drifting,
    untrained_street,
    without_sky_masks,
)

from drivesplat.kernels import triton_support
from drivesplat.kernels.capacity import capacity_for
from drivesplat.kernels.cuda_graphs import CudaGraph
from drivesplat.model.exposure import Exposures
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN
from drivesplat.model.view import RollingShutter
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.settings.train import McmcSettings, ScanTrainingSettings, TrainSettings
from drivesplat.training.coarse_to_fine import TrainingImages, reduced
from drivesplat.training.graphs import captured_steps
from drivesplat.training.graphs.captured_steps import GaussianCount, IterationGraphs, Recording, can_capture
from drivesplat.training.graphs.inputs import ScanInputs, SharedImageInputs, SharedScanInputs, can_share
from drivesplat.training.loop import Trainer
from drivesplat.training.losses import loss_terms
from drivesplat.training.scans import TrainingScan, load_scans, scan_terms
from drivesplat.training.schedule import Schedule
from drivesplat.training.views import LidarDepth, TrainingView

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


def test_another_layout_captures_anew_and_keeps_the_graphs_of_scans(monkeypatch):
    """The entries that the lists of the image need are known by then."""
    fake = FakeGraphs(monkeypatch)
    for image, kind in ((0, "image"), (0, "image"), (1, "scan"), (1, "scan")):
        fake.run(image, kind=kind)
    assert [fake.run(0, layout=1) for _ in range(2)] == [["captured", "replayed"], ["replayed"]]
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
    assert [fake.run(0) for _ in range(3)] == [["run"]] * 3


def test_overflowed_graphs_are_captured_anew(monkeypatch):
    """Torch frees the memory pool with the last graph, and cannot use it again."""
    fake = FakeGraphs(monkeypatch)
    fake.graphs._pool = (0, 1)
    for image in (0, 0, 1, 1):
        fake.run(image)
    fake.graphs.check()
    assert fake.run(0) == ["replayed"]
    fake.graphs._graphs[Recording("image", 0)].most[0] = 7000
    fake.graphs.check()
    assert fake.graphs._pool == (0, 1) and fake.run(0) == ["captured", "replayed"]
    assert [round(room) for (room,) in fake.capacities] == [3000, 3000, 7000]
    assert fake.run(1) == ["replayed"], "its lists did not overflow"
    for graph in fake.graphs._graphs.values():
        graph.most[0] = 9000
    fake.graphs.check()
    assert fake.graphs._pool is None


def images_of(views: list[TrainingView]) -> TrainingImages:
    return TrainingImages(views, Schedule.of(TrainSettings(), len(views)), 0)


@pytest.mark.parametrize(
    ("settings", "device", "compiles", "scans", "expected"),
    [
        ({}, "cuda", True, 1, True),
        ({}, "cuda", True, 2, False),
        ({}, "cpu", True, 0, False),
        ({}, "cuda", False, 0, False),
        ({"cuda_graphs": False}, "cuda", True, 0, False),
        ({"strategy": "default"}, "cuda", True, 0, False),
    ],
)
def test_which_trainings_capture_graphs(settings, device, compiles, scans, expected, monkeypatch):
    """None with classes, or with more recordings than the limit."""
    monkeypatch.setattr(triton_support, "compiles", lambda: compiles)
    views, chosen, place = guided_views(), TrainSettings(**settings), torch.device(device)
    monkeypatch.setattr(captured_steps, "MAX_RECORDINGS", len(views) + 1)
    assert can_capture(chosen, images_of(views), place, scans=scans) == expected
    labelled = [dataclasses.replace(view, classes=torch.zeros_like(view.sky, dtype=torch.uint8)) for view in views]
    assert not can_capture(chosen, images_of(labelled), place)


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


def with_depths(view: TrainingView, count: int) -> TrainingView:
    """A view with LiDAR depth at so many pixels; some of the errors are large."""
    rng = np.random.default_rng(count)
    pixels = rng.permutation(view.view.width * view.view.height)[:count]
    depth = np.where(rng.random(count) < 0.1, 50.0, rng.uniform(2.0, 6.0, count))
    return dataclasses.replace(view, lidar=LidarDepth(torch.from_numpy(pixels), torch.from_numpy(depth).float()))


def inputs_for(views: list[TrainingView], by_camera: bool = False) -> SharedImageInputs:
    return SharedImageInputs(TrainingImages(views, Schedule.of(settings_of(), len(views)), 0), by_camera)


@pytest.mark.parametrize(("drifting", "night"), [(False, False), (True, False), (False, True)])
def test_an_iteration_with_shared_inputs_has_the_loss_and_the_gradients_of_its_image(drifting, night):
    """One after the other, in inputs of the same addresses, with different amounts of LiDAR depth."""
    settings = settings_of(**ALL_TERMS)
    model = untrained_drifting(settings) if drifting else untrained_street(settings)
    views = [with_depths(view, count) for view, count in zip(guided_views(), (150, 3, 200, 90, 1), strict=False)]
    views = without_sky_masks(views) if night else views
    before, shared, addresses = [view.pixels.clone() for view in views], inputs_for(views), set()
    for view in views:
        assert can_share(view)
        inputs = shared.load(view, model.states(view.view.time))
        addresses.add((inputs.number, inputs.image.pixels.data_ptr(), inputs.image.lidar.depth.data_ptr()))
        alone = model.render(view.view, with_depth=True)
        sets = model.sample(inputs.states)
        together = model.render(inputs.view.view, gaussians=sets, with_depth=True)
        expected, found = loss_terms(alone, view, model, settings), loss_terms(together, inputs.view, model, settings)
        assert found.keys() == expected.keys() and {"depth", "horizon" if night else "sky_bce"} <= found.keys()
        torch.testing.assert_close(found, expected)
        pulls = [
            torch.autograd.grad(sum(terms.values()), [part.params["means"] for part in model.parts])
            for terms in (expected, found)
        ]
        torch.testing.assert_close(*pulls)
    assert len(addresses) == 1 and len(views) > 2
    assert all(torch.equal(view.pixels, pixels) for view, pixels in zip(views, before, strict=True))


@pytest.mark.parametrize("by_camera", [False, True])
def test_images_of_other_shapes_have_inputs_of_their_own_and_those_of_other_cameras_with_exposures(by_camera):
    views = guided_views()
    model = untrained_street(settings_of())
    states = model.states(0.5)
    others = [
        views[0],
        reduced(views[0], 2),
        dataclasses.replace(views[0], sky=None),
        dataclasses.replace(views[0], sky=None, not_sky=views[0].sky),
        dataclasses.replace(views[0], lidar=None),
        dataclasses.replace(views[0], view=dataclasses.replace(views[0].view, camera="CAM_BACK")),
    ]
    shared = inputs_for(views, by_camera)
    assert [shared.load(view, states).number for view in (*others, *others)] == [0, 1, 2, 3, 4, 5 * by_camera] * 2


def test_images_whose_graph_serves_no_other_are_not_shared():
    (view, *_) = guided_views()
    assert can_share(view)
    assert not can_share(dataclasses.replace(view, classes=torch.zeros(view.pixels.shape[:2], dtype=torch.uint8)))
    shutter = RollingShutter(torch.tensor([0.0, 0.03, 0.0]), torch.zeros(3, 4))
    assert not can_share(dataclasses.replace(view, view=dataclasses.replace(view.view, shutter=shutter)))


def replayed(monkeypatch: pytest.MonkeyPatch, trainer: Trainer) -> list[Recording]:
    """Has a trainer on a CPU replay iterations: a replay runs what was captured, whatever the trainer passes now.
    Returns what it captures."""
    captured = []

    def capture(graphs: IterationGraphs, recording: Recording, gaussians: float, iteration: Callable) -> CudaGraph:
        captured.append(recording)
        result: dict[str, torch.Tensor] = {}
        none = torch.zeros(0, dtype=torch.int32)
        graph = CudaGraph(lambda: result.update(iteration()), result, none, [], none)
        graphs._graphs[recording] = graph
        return graph

    monkeypatch.setattr(IterationGraphs, "_capture", capture)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda _: None)
    trainer.steps.graphs.enabled = True
    return captured


@pytest.mark.parametrize(
    ("people", "exposed"), [pytest.param(False, False, marks=pytest.mark.slow), (True, False), (False, True)]
)
def test_replays_train_as_iterations_do(people, exposed, monkeypatch):
    """With images of two cameras, reduced at first: after the first of each kind all iterations are replays."""
    settings = settings_of(**ALL_TERMS, refine_start=1.0, iterations=24, mcmc=McmcSettings(noise_lr=0.0))
    monkeypatch.setattr(TrainingImages, "factor", lambda _, step: 2 if step < 10 else 1)
    views = [with_depths(view, 40 + 30 * i) for i, view in enumerate(guided_views())]
    views[0] = dataclasses.replace(views[0], view=dataclasses.replace(views[0].view, camera="CAM_BACK"))
    losses = []
    for replays in (False, True):
        model = untrained_street(settings, people=people)
        first, nodes = {"CAM_BACK": torch.full((3,), 0.9)}, torch.tensor([0.0, 1.0])
        model.exposure = Exposures(first, settings.exposure, ("CAM_FRONT",), nodes) if exposed else None
        trainer = Trainer.begin(model, views, settings, 0, torch.device("cpu"))
        captured = replayed(monkeypatch, trainer) if replays else []
        losses.append([])
        for _ in range(settings.iterations):
            terms = trainer.training_step(with_picture=False)[0]
            losses[-1].append({name: float(value) for name, value in terms.items()})
            trainer.state.step += 1
    sizes, cameras = 2, 1 + exposed
    assert 0 < len(captured) <= sizes * cameras
    for eager, mine in zip(*losses, strict=True):
        assert mine == pytest.approx(eager, rel=1e-3)
    assert sum(losses[0][-1].values()) < sum(losses[0][0].values())


@pytest.mark.parametrize(
    ("cameras", "images", "by_camera", "measured"),
    [(1, 40, True, 8), (6, 40, False, 8), (6, 40, True, 4), (2, 40, True, 4), (3, 2, True, 2), (3, 1, True, 1)],
)
def test_cameras_with_their_own_graphs_share_the_images_that_are_measured(cameras, images, by_camera, measured):
    one = guided_views()[0]
    views = [dataclasses.replace(one.view, camera=f"CAM_{c}") for c in range(cameras) for _ in range(images)]
    shared = inputs_for([dataclasses.replace(one, view=view) for view in views], by_camera)
    assert shared.measured == measured


SETTINGS = settings_of(scans=ScanTrainingSettings(per_image=1.0))


def revolution(x: float, seconds: float) -> RecordedScan:
    """A scan of a wall by a sensor that moves and turns meanwhile; other rays return at each `seconds`."""
    scan = scan_of_a_wall(x, intensity=0.2 + 0.1 * seconds)
    rays = scan.scan.rays
    order = np.random.default_rng(round(10 * seconds)).permutation(30)  # in which its firings fire
    offsets = np.broadcast_to(np.linspace(-0.05, 0.05, 30, dtype=np.float32)[order], rays.offsets_s.shape)
    rays = replace(rays, azimuths=rays.azimuths + np.float32(0.01 * seconds), offsets_s=offsets.copy())
    blocked = scan.blocked.copy()
    blocked[round(5 * seconds)] = True
    returned = scan.scan.returned & (rays.elevations > 0.1 * seconds - 0.1)
    taken = replace(scan.scan, rays=rays, returned=returned)
    moving = {"linear": np.array([3.0, seconds, 0.0]), "angular": np.array([0.0, 0.0, 0.3])}
    return replace(scan, seconds=seconds, scan=taken, blocked=blocked, **moving)


def terms_of(model: SplatModel, scan: TrainingScan, inputs: ScanInputs | None = None) -> dict[str, float]:
    """The loss terms of a scan; with `inputs` by their tensors alone."""
    sets = None if inputs is None else model.sample(inputs.states, SCAN)
    picture = model.scan(scan.view, gaussians=sets, before=scan.range - 0.5)
    return {name: float(value.detach()) for name, value in scan_terms(picture, scan, model, SETTINGS).items()}


def test_scans_of_one_shape_share_their_inputs():
    model, shared = untrained_street(SETTINGS, lidar_logits=(0.0, 2.0)), SharedScanInputs()
    scans = load_scans([revolution(0.0, 0.4), revolution(0.6, 1.2)], SETTINGS.scans, CPU)
    expected = [terms_of(model, scan) for scan in scans]
    assert all(abs(expected[0][name] - expected[1][name]) > 1e-4 for name in ("scan_range", "scan_intensity"))
    places = set()
    for i in (0, 1, 0):
        inputs = shared.load(scans[i], model.states(scans[i].view.time, SCAN))
        assert terms_of(model, inputs.scan, inputs) == expected[i] and inputs.number == 0
        places.add(tuple(values.data_ptr() for values in inputs.tensors))
    assert len(places) == 1, "a graph keeps the addresses"
    assert [terms_of(model, scan) for scan in scans] == expected, "the scans themselves are unchanged"


def test_scans_of_other_shapes_have_inputs_of_their_own():
    """Without intensity, or without rays that the vehicle blocks."""
    model, shared, full = untrained_street(SETTINGS, lidar_logits=(0.0, 2.0)), SharedScanInputs(), revolution(0.0, 0.4)
    silent = replace(full, scan=replace(full.scan, intensities=None))
    scans = load_scans([full, silent, replace(full, blocked=np.zeros_like(full.blocked)), full], SETTINGS.scans, CPU)
    numbers = [shared.load(scan, model.states(scan.view.time, SCAN)).number for scan in scans]
    assert numbers == [0, 1, 2, 0]


def held_by(value: object, path: str = "scan") -> dict[str, torch.Tensor]:
    """All tensors that a scan holds, cached ones too, by their names."""
    if isinstance(value, torch.Tensor):
        return {path: value}
    if isinstance(value, (list, tuple)):
        names = getattr(value, "_fields", range(len(value)))
        items = zip(names, value, strict=True)
    else:
        items = ((name, item) for name, item in getattr(value, "__dict__", {}).items() if item is not value)
    return {k: v for name, item in items for k, v in held_by(item, f"{path}.{name}").items()}


def test_the_tensors_of_a_scan_are_all_that_it_holds():
    """Also what a rendering has cached. One that `tensors` forgot would keep the values of the first scan."""
    (scan,) = load_scans([revolution(0.0, 0.4)], SETTINGS.scans, CPU)
    terms_of(untrained_street(SETTINGS, lidar_logits=(0.0, 2.0)), scan)
    known, held = {values.data_ptr() for values in scan.tensors}, held_by(scan)
    assert len(held) > 30 and any("borders" in name for name in held)
    assert [name for name, values in held.items() if values.data_ptr() not in known] == []
