"""Tests that need a GPU: gsplat compared with the reference, trainings, films, CUDA graphs, and exhausted memory."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import gsplat
import numpy as np
import pytest
import torch
from gsplat import MCMCStrategy
from gsplat.relocation import compute_relocation
from helpers.patience import PATIENCE_S
from helpers.reference_rasterizer import rasterize_reference
from helpers.trainings import (
    ALL_TERMS,
    EndedError,
    EndingViews,
    guided_views,
    in_subprocess,
    mean_psnr,
    recorded_views,
    scan_of_a_wall,
    settings_of,
    trained,
    untrained,
    untrained_drifting,
    untrained_road,
    untrained_street,
    without_sky_masks,
)
from scipy.spatial.transform import Rotation

from drivesplat.errors import DeviceError, DriveSplatError, TrainingError
from drivesplat.io.prefetch import prefetch_items
from drivesplat.kernels import capacity
from drivesplat.kernels.cuda_graphs import CudaGraph, capture, capture_stream, new_pool
from drivesplat.kernels.mcmc import relocation
from drivesplat.machine.device import choose_device
from drivesplat.model.background import Background
from drivesplat.model.exposure import Exposures
from drivesplat.model.gaussians import concatenate
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import IMAGE, SCAN, ActorPlacement, Want
from drivesplat.model.view import RollingShutter, View
from drivesplat.rasterization import Rendering, rasterize
from drivesplat.rendering import fixed_model
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.rendering.frames import film_frame, film_frames
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.shutter import Shutter
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import (
    ExposureSettings,
    GaussianSettings,
    McmcSettings,
    ScanTrainingSettings,
    TrainSettings,
)
from drivesplat.settings.train_objects import DeformableSettings
from drivesplat.training import step as step_module
from drivesplat.training import strategies
from drivesplat.training.augmentation import mirrored_at_random, with_dropout
from drivesplat.training.graphs import captured_steps
from drivesplat.training.loop import Trainer, TrainingSummary
from drivesplat.training.scans import initial_lidar_logits, load_scans

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU that torch can use"),
]

GPU = torch.device("cuda")
WIDTH, HEIGHT = 96, 64
INPUTS = ("means", "quats", "scales", "opacities", "colors")


def random_scene(count: int = 3000, cameras: int = 2) -> dict[str, torch.Tensor]:
    """Gaussians before, beside and behind two cameras, with colours of degree 3; float64 on the CPU."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(-1.0, 12.0, count)
    viewmats = np.tile(np.eye(4), (cameras, 1, 1))
    viewmats[:, :3, :3] = Rotation.from_euler("xyz", rng.uniform(-0.2, 0.2, (cameras, 3))).as_matrix()
    viewmats[:, :3, 3] = rng.uniform(-0.5, 0.5, (cameras, 3))
    arrays = {
        "means": np.stack([rng.uniform(-9, 9, count), rng.uniform(-6, 6, count), depth], axis=1),
        "quats": rng.normal(size=(count, 4)),
        "scales": np.exp(rng.uniform(-4.0, -1.0, (count, 3))),
        "opacities": rng.uniform(0.01, 1.0, count),
        "colors": rng.normal(size=(count, 16, 3)) * 0.3,
        "viewmats": viewmats,
        "Ks": np.tile([[70.0, 0.0, 46.0], [0.0, 75.0, 33.0], [0.0, 0.0, 1.0]], (cameras, 1, 1)),
    }
    return {name: torch.from_numpy(values) for name, values in arrays.items()}


def seen_and_gradients(
    rasterizer: Callable[..., Rendering], dtype: torch.dtype, antialiased: bool
) -> dict[str, torch.Tensor]:
    """Image, alpha and depth of the random scene, and the gradients of a random weighting of all three."""
    scene = {name: value.to(GPU, dtype) for name, value in random_scene().items()}
    for name in INPUTS:
        scene[name].requires_grad_()
    rendering = rasterizer(**scene, width=WIDTH, height=HEIGHT, sh_degree=3, antialiased=antialiased, with_depth=True)
    seen = {"image": rendering.image, "alpha": rendering.alpha, "depth": rendering.depth}
    generator = torch.Generator().manual_seed(1)
    weights = {name: torch.rand(value.shape, generator=generator, dtype=torch.float64) for name, value in seen.items()}
    torch.stack([(value * weights[name].to(value)).sum() for name, value in seen.items()]).sum().backward()
    gradients = {f"gradient of {name}": scene[name].grad for name in INPUTS}
    return {name: value.detach().double() for name, value in {**seen, **gradients}.items()}


@pytest.mark.parametrize("antialiased", [False, True])
def test_gsplat_agrees_with_the_reference(antialiased):
    expected = seen_and_gradients(rasterize_reference, torch.float64, antialiased)
    found = seen_and_gradients(rasterize, torch.float32, antialiased)
    assert 0.05 < float(expected["alpha"].mean()) < 0.95
    wrong = {}
    for name, truth in expected.items():
        error = (found[name] - truth).abs().flatten() / truth.abs().max()
        typical, worst = float(torch.quantile(error, 0.999)), float(error.max())
        if not (typical <= 1e-3 and worst <= 1e-2):
            wrong[name] = (typical, worst)
    assert not wrong, f"99.9th percentile and maximum of the error, over the tensor's maximum: {wrong}"


def test_gpu_tensors_are_rendered_by_gsplat(monkeypatch):
    scene = {name: value.to(GPU, torch.float32) for name, value in random_scene(100).items()}
    asked, projection = [], gsplat.fully_fused_projection
    monkeypatch.setattr(gsplat, "fully_fused_projection", lambda *a, **k: asked.append(1) or projection(*a, **k))
    info = rasterize(**scene, width=WIDTH, height=HEIGHT, sh_degree=3).info
    assert asked == [1]
    assert {"means2d", "radii", "width", "height", "n_cameras", "gaussian_ids"} <= info.keys()


@pytest.mark.parametrize(("count", "with_depth"), [(50, True), (0, True), (0, False)])
def test_without_a_gaussian_in_view_images_are_zero_and_gradients_finite(count, with_depth):
    scene = {name: value.to(GPU, torch.float32) for name, value in random_scene(50).items()}
    scene["means"][:, 2] = -5.0
    for name in INPUTS:
        scene[name] = scene[name][:count].requires_grad_()
    rendering = rasterize(**scene, width=WIDTH, height=HEIGHT, sh_degree=3, with_depth=with_depth)
    assert rendering.image.shape == (2, HEIGHT, WIDTH, 3) and rendering.alpha.shape == (2, HEIGHT, WIDTH, 1)
    assert not rendering.image.any() and not rendering.alpha.any()
    assert (rendering.depth is not None) == with_depth and not (with_depth and rendering.depth.any())
    if count:
        (rendering.image.sum() + rendering.depth.sum()).backward()
        assert all(torch.isfinite(scene[name].grad).all() for name in INPUTS)


def test_film_frames_and_removals_agree_with_the_cpu():
    """Frames equal those of the CPU; pixels that no removed Gaussian reaches are equal before and after the removal."""
    scene = random_scene()
    background = Background(
        {
            "means": scene["means"], "quats": scene["quats"], "scales": scene["scales"].log(),
            "opacities": torch.logit(scene["opacities"].clamp(max=0.999)), "sh0": scene["colors"][:, :1],
            "shN": scene["colors"][:, 1:],
        },
        GaussianSettings(), 1.0,
    ).float()  # fmt: skip
    model = SplatModel([background], ConstantSky(torch.full((3,), 0.6), 0.01))
    view = View(scene["Ks"][0].float(), torch.eye(4), WIDTH, HEIGHT, 0.0)
    on_gpu = View(view.K.to(GPU), view.camera_to_world.to(GPU), WIDTH, HEIGHT, 0.0)
    on_cpu_frame = film_frame(model, view).astype(int)
    model = model.to(GPU)
    assert np.percentile(np.abs(film_frame(model, on_gpu) - on_cpu_frame), 99) <= 1
    with torch.no_grad():
        gaussians = model.at(0.0)
        removed = (gaussians.means[:, 0] < 0) & (gaussians.means[:, 2] < 4)
        before, after, alone = (
            model.render(on_gpu, gaussians=some) for some in (gaussians, gaussians[~removed], gaussians[removed])
        )
    untouched = alone.alpha == 0.0
    assert 0.0 < untouched.float().mean() < 1.0
    assert torch.equal(before.image[untouched], after.image[untouched])
    assert not torch.equal(before.image, after.image)


def test_actors_agree_with_the_cpu():
    """Positions, colors and presence of two cars, one of which appears later, the colours of a recoloured one, and the
    alpha of the objects alone."""
    model = untrained_street(settings_of())
    with torch.no_grad():
        for value in (value for value in model.parameters() if value.requires_grad):
            value += 0.1 * torch.randn(value.shape, generator=torch.Generator().manual_seed(0))
    matrix = np.array([[0.2, 0.7, 0.1], [0.0, 0.4, 0.3], [0.9, 0.0, 0.2]])
    first, *others = (track.id for track in model.parts[1].timeline.tracks)
    edited = Want(placements=(ActorPlacement(first, color_matrix=matrix), *map(ActorPlacement, others)))
    wanted = [(0.7, edited), *((time, IMAGE) for time in (0.0, 0.3, 1.1, 1.9, 5.0))]
    view = recorded_views(1, width=96, height=64)[0].view
    on_cpu = [model.at(time, want) for time, want in wanted]
    assert bool((on_cpu[0].sh != model.at(0.7).sh).any())
    alone_on_cpu = model.objects_alpha(model.render(view), view).detach()
    model, on_gpu = model.to(GPU), recorded_views(1, width=96, height=64, device=GPU)[0].view
    for (time, want), expected in zip(wanted, on_cpu, strict=True):
        found = model.at(time, want)
        for name, values in found.tensors.items():
            torch.testing.assert_close(values.cpu(), expected.tensors[name], rtol=1e-4, atol=1e-5)
    alone = model.objects_alpha(model.render(on_gpu), on_gpu).detach().cpu()
    assert float(alone.max()) > 0.1 and float((alone - alone_on_cpu).abs().quantile(0.99)) < 1e-3
    beside = model.render(on_gpu, with_objects=True).objects_alpha.detach().cpu()
    assert float((beside - alone).abs().quantile(0.99)) < 1e-3


def test_a_rolling_shutter_agrees_with_the_cpu():
    model = untrained_street(settings_of())
    model.sky = CubemapSky(8, torch.full((3,), 0.5), 1e-2)
    model.sky.params["texels"].data += torch.randn(model.sky.params["texels"].shape)
    on_cpu = recorded_views(1, width=96, height=64)[0].view
    expected = model.render(rolling(on_cpu), with_depth=True)
    still = model.render(on_cpu)
    on_gpu = rolling(recorded_views(1, width=96, height=64, device=GPU)[0].view)
    found = model.to(GPU).render(on_gpu, with_depth=True)
    apart = (found.image.cpu() - expected.image).detach().abs().flatten()
    assert float(apart.quantile(0.999)) < 1e-3 and float((still.image - expected.image).abs().max().detach()) > 0.02
    seen = expected.alpha > 0.5
    torch.testing.assert_close(found.depth.cpu()[seen], expected.depth[seen], rtol=1e-3, atol=1e-3)


def test_relocation_agrees_with_gsplat():
    generator = torch.Generator().manual_seed(0)
    ratios = torch.arange(1, 21).repeat(50)
    opacities = torch.rand(len(ratios), generator=generator) * 0.97 + 0.02
    scales = torch.rand(len(ratios), 3, generator=generator) + 0.05
    binoms = MCMCStrategy().initialize_state()["binoms"]
    expected = compute_relocation(opacities.to(GPU), scales.to(GPU), ratios.to(GPU), binoms.to(GPU))
    found = relocation(opacities, scales, ratios, binoms)
    for ours, gsplats in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, gsplats.cpu(), rtol=1e-3, atol=1e-6)


def gpu_settings(strategy: str, **changes: Any) -> TrainSettings:
    """200 iterations with a checkpoint in the middle."""
    return settings_of(strategy, **{"iterations": 200, "checkpoint_every": 80, "cap_max": 140, **changes})


def gpu_views() -> list:
    return recorded_views(width=64, height=48, device=GPU)


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_training_of_actors_learns_and_resumes(strategy, tmp_path):
    """With all loss terms, and corrections of tracks. Its summary names the GPU and its peak memory."""
    settings = gpu_settings(strategy, **ALL_TERMS)

    def ended(name: str, views: list) -> tuple[SplatModel, TrainingSummary]:
        return trained(tmp_path / name, settings, views, device=GPU, model=untrained_street(settings))

    before = mean_psnr(untrained_street(settings).to(GPU), guided_views(GPU))
    whole, summary = ended("whole", guided_views(GPU))
    assert summary.device == torch.cuda.get_device_name()
    assert 0.0 < summary.peak_gpu_memory_gb <= torch.cuda.max_memory_reserved() / 1e9
    with pytest.raises(EndedError):
        ended("it", EndingViews(guided_views(GPU), 120))
    resumed, summary = ended("it", guided_views(GPU))
    assert summary.resumed_at == [80] and resumed.parts[1].shared["translation"].any()
    found, expected = (mean_psnr(model, guided_views(GPU)) for model in (resumed, whole))
    assert expected > before + 3.0 and found == pytest.approx(expected, abs=0.5)


def print_what_stops(folder: str, strategy: str, fault: str) -> None:
    """For a subprocess: prints the message with which a failing training ends.

    An unexpected assertion in a kernel makes the GPU unusable for the whole process.
    """
    gaussians = GaussianSettings(sh_degree=1, lr_sh0=1e30) if fault == "not finite" else GaussianSettings(sh_degree=1)
    settings = gpu_settings(strategy, gaussians=gaussians, refine_start=0.0, log_every=50, checkpoint_every=1000)
    model = untrained(settings)
    if fault == "none left":
        with torch.no_grad():
            model.parts[0].params["opacities"].fill_(-30.0)
    try:
        trained(Path(folder), settings, gpu_views(), device=GPU, model=model)
    except TrainingError as error:
        print(error)


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
@pytest.mark.parametrize(
    ("fault", "pattern"), [("not finite", r"^iteration 2: .*ssim.* not finite"), ("none left", r"no Gaussian is left")]
)
def test_a_failing_training_ends_with_a_message(tmp_path, strategy, fault, pattern):
    process = in_subprocess(print_what_stops, str(tmp_path), strategy, fault)
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert re.search(pattern, output), output + errors[-3000:]


def print_out_of_memory(folder: str, gaussians: str, gigabytes: str) -> None:
    """For a subprocess: a training on a GPU whose memory is limited to `gigabytes`."""
    count = int(gaussians)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([6.0, 3.0, 3.0]) + torch.tensor([-3.0, -1.5, 3.0])
    params = {
        "means": means, "scales": torch.full((count, 3), math.log(0.02)), "quats": torch.rand(count, 4),
        "opacities": torch.zeros(count), "sh0": torch.zeros(count, 1, 3), "shN": torch.zeros(count, 15, 3),
    }  # fmt: skip
    settings = gpu_settings("mcmc", cap_max=2 * count, mcmc=McmcSettings(), gaussians=GaussianSettings())
    model = SplatModel([Background(params, settings.gaussians, 1.0)], None)
    views = gpu_views()
    torch.cuda.set_per_process_memory_fraction(float(gigabytes) * 1e9 / torch.cuda.mem_get_info()[1])
    try:
        trained(Path(folder), settings, views, device=GPU, model=model)
    except DriveSplatError as error:
        print(type(error).__name__, error)


@pytest.mark.parametrize(
    ("gaussians", "gigabytes"),
    [pytest.param(400_000, 0.35, id="while training"), pytest.param(400_000, 0.05, id="before the first iteration")],
)
def test_exhausted_memory_is_reported_with_the_number_of_gaussians_and_a_remedy(tmp_path, gaussians, gigabytes):
    process = in_subprocess(print_out_of_memory, str(tmp_path), str(gaussians), str(gigabytes))
    output, errors = process.communicate(timeout=PATIENCE_S)
    assert output.startswith("DeviceError "), output + errors[-3000:]
    assert f"{gaussians:,} Gaussians" in output
    assert re.search(r"peak \d+\.\d GB", output) and "train.cap_max" in output


def test_too_little_free_memory_is_refused_with_both_numbers():
    assert choose_device(DeviceSettings(min_free_gb=0.1)) == GPU
    free, total = (size / 1e9 for size in torch.cuda.mem_get_info())
    asked = min(1000.0, math.ceil(total) + 1.0)
    with pytest.raises(DeviceError) as error:
        choose_device(DeviceSettings(min_free_gb=asked))
    message = str(error.value)
    named = float(re.search(r"has ([\d.]+) GB of free memory", message).group(1))
    assert named == pytest.approx(free, abs=0.05 * total)
    assert f"asks for {asked:g}" in message


Film = tuple[SplatModel, list[View], list[np.ndarray]]


@pytest.fixture
def street_film() -> Film:
    """A model with cars and a sky, views of it with a changing focal length, and their frames rendered one by one."""
    model = untrained_street(settings_of()).to(GPU)
    model.sky = CubemapSky(4, torch.full((3,), 0.5), 1e-2).to(GPU)
    model.sky.params["texels"].data.normal_(generator=torch.Generator(GPU).manual_seed(0))
    model.requires_grad_(False)
    views = [replace(view.view, camera=None) for view in guided_views(GPU)]
    views = [replace(view, K=view.K * view.K.new_tensor([1.0 + 0.1 * i, 1.0, 1.0])) for i, view in enumerate(views)]
    model.precompute([view.time for view in views])
    return model, views, [film_frame(model, view) for view in views]


@pytest.fixture
def captures(monkeypatch) -> list[CudaGraph]:
    """What is captured from now on, with lists that have exactly the room that those before them needed."""
    made, capture = [], fixed_model.capture
    monkeypatch.setattr(fixed_model, "capture", lambda *t, **named: made.append(capture(*t, **named)) or made[-1])
    monkeypatch.setattr(capacity, "MIN_CAPACITY", 0)
    monkeypatch.setattr(capacity, "MARGIN", 1.0)
    return made


def overflowed(graph: CudaGraph) -> bool:
    """Whether a replay needed more entries than a list has."""
    return any(most > available for most, available in zip(graph.most.tolist(), graph.capacities, strict=True))


def assert_frames(found: list[np.ndarray], expected: list[np.ndarray]) -> None:
    assert max(np.abs(a.astype(int) - b).mean() for a, b in pairwise(expected)) > 1.0, "they differ"
    for frame, alone in zip(found, expected, strict=True):
        np.testing.assert_allclose(frame.astype(int), alone, atol=1)


def test_the_frames_of_a_film_equal_single_frames(street_film, captures, monkeypatch):
    """With one capture; also with Gaussians of one's own and another size in between, and for two films alternately."""
    model, views, expected = street_film
    timeline = model.parts[1].timeline
    known = dict(timeline._cache)
    monkeypatch.setattr(capacity, "MARGIN", 4.0)
    assert_frames([*film_frames(model, [(view, None) for view in views])], expected)
    assert len(captures) == 1 and captures[0] is not None
    edited = [(view, model.at(view.time) if i % 2 else None) for i, view in enumerate(views)]
    by_turns = zip(film_frames(model, [(view, None) for view in views]), film_frames(model, edited), strict=True)
    for together in zip(*by_turns, strict=True):
        assert_frames(list(together), expected)
    smaller = [replace(view, width=64) for view in views]
    mixed = [*film_frames(model, [(view, None) for pair in zip(views, smaller, strict=True) for view in pair])]
    assert_frames(mixed[::2], expected)
    assert_frames(mixed[1::2], [film_frame(model, view) for view in smaller])
    assert None not in captures and timeline._cache == known, "all states were precomputed"


def test_a_film_whose_lists_overflow_is_captured_anew(street_film, captures):
    """Beside a thread that uses its frames; on the second pass the last graph has the capacity for all of it."""
    model, views, expected = street_film
    found = [*prefetch_items(film_frames(model, [(view, None) for view in [*views, *views]]))]
    assert len(captures) > 1 and None not in captures
    assert any(map(overflowed, captures[:-1])) and not overflowed(captures[-1])
    assert_frames(found, [*expected, *expected])


def test_a_film_that_drops_its_only_graph_captures_another(street_film, monkeypatch, caplog):
    """While nothing else keeps the graph, so that torch frees its memory."""
    model, views, expected = street_film
    monkeypatch.setattr(capacity, "MIN_CAPACITY", 0)
    monkeypatch.setattr(capacity, "MARGIN", 1.0)
    found = [*film_frames(model, [(view, None) for view in [*views, *views]])]
    assert not caplog.records
    torch.cuda.empty_cache()
    assert_frames(found, [*expected, *expected])


def test_an_abandoned_film_does_not_affect_the_next(street_film, captures):
    model, views, expected = street_film
    given_up = film_frames(model, [(view, None) for view in [*views, *views]])
    for _ in range(7):
        next(given_up)
    given_up.close()
    assert_frames([*film_frames(model, [(view, None) for view in views])], expected)


def test_static_films_and_frames_of_a_camera_of_the_rig_are_captured_too(street_film, captures, monkeypatch):
    model, views, expected = street_film
    monkeypatch.setattr(capacity, "MARGIN", 4.0)
    of_rig = [(replace(view, camera="CAM_BACK"), None) for view in views]
    assert_frames([*film_frames(model, of_rig)], expected)
    assert len(captures) == 1
    alone = SplatModel([model.parts[0]], model.sky)
    assert_frames([*film_frames(alone, [(view, None) for view in views])], [film_frame(alone, view) for view in views])
    assert len(captures) == 2 and None not in captures


def test_frames_that_cannot_be_captured_are_rendered_without_a_graph(street_film, monkeypatch, caplog):
    model, views, expected = street_film
    render = SplatModel.render

    def waiting(self, view, **named):
        assert float(view.camera_to_world.sum()) < 1e9
        return render(self, view, **named)

    monkeypatch.setattr(SplatModel, "render", waiting)
    assert_frames([*film_frames(model, [(view, None) for view in views])], expected)
    (record,) = caplog.records
    assert record.message.startswith("renderings cannot be captured as a CUDA graph")


def test_scans_of_a_fixed_model_replay_one_graph(captures, monkeypatch):
    """Scans with the same rays, and with others of as many; their results are their own."""
    model = untrained_street(settings_of(), (0.3, 0.9)).to(GPU)
    model.requires_grad_(False)
    monkeypatch.setattr(capacity, "MARGIN", 4.0)
    fixed, rays = FixedModel(model), scan_of_a_wall().scan
    same = [replace(scan_of_a_wall(x), seconds=x, scan=rays) for x in (0.2, 0.6, 1.0)]
    views = [fixed.scan_view(scan, (3e-4, 3e-4)) for scan in [*same, scan_of_a_wall(1.4)]]
    found = [fixed.scan(view, fixed.sample(view.time, SCAN)) for view in views]
    assert len(captures) == 1 and captures[0] is not None
    for view, picture in zip(views, found, strict=True):
        alone = model.scan(view)
        assert float(alone.alpha.max()) > 0.1
        for name in ("range", "returned", "intensity", "alpha"):
            torch.testing.assert_close(getattr(picture, name), getattr(alone, name), atol=1e-4, rtol=1e-4)


def rolling(view: View) -> View:
    """The view of a camera that moves and turns while its lines are read."""
    shutter = Shutter(np.array([0.0, 0.08, 0.01]), np.array([0.5, 0.1, 2.0, 0.05, -0.3, 0.1]))
    tensors = (torch.from_numpy(values).float().to(view.K.device) for values in (shutter.readout_s, shutter.motion))
    return replace(view, shutter=RollingShutter(*tensors))


def trained_with(
    capture: bool, iterations: int = 30, iterations_done: int | None = None, shutters: bool = False,
    recorded: Sequence[RecordedScan] = (), people: bool = False, drifting: bool = False, road: bool = False,
    night: bool = False, exposed: bool = False, **settings,
) -> tuple[Trainer, list[float]]:  # fmt: skip
    """A training of background and cars, people, drifting Gaussians or a road, by every loss term, with or without CUDA
    graphs, rolling shutters, scans, exposure over time, by day or by night."""
    chosen = settings_of(**{**ALL_TERMS, "mcmc": McmcSettings(noise_lr=0.0), "refine_start": 1.0, **settings})
    logits = initial_lidar_logits(recorded) if recorded else None
    static = untrained_road if road else untrained_drifting if drifting else None
    model = static(chosen) if static else untrained_street(chosen, logits, people)
    for part in model.parts:  # no spheres, whose rotations learn from rounding
        part.params["scales"].data += 0.5 * torch.randn(
            part.params["scales"].shape, generator=torch.Generator().manual_seed(0)
        )
    views = without_sky_masks(guided_views(GPU)) if night else guided_views(GPU)
    if shutters:
        model.sky = CubemapSky(8, torch.full((3,), 0.5), 1e-2)
        views = [replace(view, view=rolling(view.view)) for view in views]
    if exposed:
        model.exposure = Exposures({}, chosen.exposure, ("CAM_FRONT",), torch.tensor([0.0, 0.5, 1.0]))
        views = [
            replace(it, view=replace(it.view, camera="CAM_FRONT", seconds=torch.tensor(it.view.time, device=GPU)))
            for it in views
        ]
    chosen = chosen.model_copy(update={"cuda_graphs": capture, "iterations": iterations})
    with capture_stream(GPU):
        trainer = Trainer.begin(model.to(GPU), views, chosen, 0, GPU, scans=load_scans(recorded, chosen.scans, GPU))
        losses = [
            float(torch.stack(list(continued(trainer).values())).sum()) for _ in range(iterations_done or iterations)
        ]
    trainer.state.guard.check("nowhere")
    return trainer, losses


def steps_of(trainer: Trainer) -> dict[str, int]:
    """The number of steps of each optimizer."""
    optimizers = trainer.state.optimizers.all()
    return {name: int(optimizer.state[optimizer.parameter]["step"]) for name, optimizer in optimizers}


def continued(trainer: Trainer, iterations: int = 1) -> dict[str, torch.Tensor]:
    """The loss terms of the last of so many iterations."""
    for _ in range(iterations):
        terms, picture, _ = trainer.training_step(with_picture=False)
        trainer.densify(picture)
    return terms


def with_and_without_graphs(caplog, graphs: int, **training) -> tuple[Trainer, Trainer, list[float]]:
    """Trainings by so many graphs and by none, whose losses agree, and the losses."""
    captured, mine = trained_with(True, **training)
    eager, theirs = trained_with(False, **training)
    assert not caplog.records, "nothing was refused"
    assert len(captured.steps.graphs._graphs) == graphs and not eager.steps.graphs._graphs
    np.testing.assert_allclose(mine, theirs, rtol=0.02)
    return captured, eager, mine


@pytest.mark.parametrize(("shutters", "night"), [(False, False), (True, False), (False, True)])
def test_a_training_by_cuda_graphs_learns_what_it_learns_without(shutters, night, caplog):
    """Also parameters that learn late: colours depend on direction after images have been captured. Images with rolling
    shutters have a graph each, others one together."""
    graphs = len(guided_views()) if shutters else 1
    captured, eager, mine = with_and_without_graphs(caplog, graphs, shutters=shutters, night=night, sh_every=0.5)
    assert mine[-1] < 0.8 * mine[0] and steps_of(captured) == steps_of(eager)
    before = untrained_street(captured.schedule.settings).state_dict()
    for name, value in ((name, value) for name, value in eager.state.model.state_dict().items() if name in before):
        moved = (value.cpu() - before[name]).abs().float()
        if moved.any() and not name.endswith(("scales", "quats")):
            apart = (captured.state.model.state_dict()[name] - value).abs().cpu()
            assert float(apart.quantile(0.5)) <= 0.1 * float(moved.max()), name


def test_exposure_over_time_is_captured_and_learns_what_it_learns_without_graphs(caplog):
    captured, eager, _ = with_and_without_graphs(caplog, 1, exposed=True, exposure=ExposureSettings(start=0.0))
    mine, theirs = (trainer.state.model.exposure.params["CAM_FRONT"] for trainer in (captured, eager))
    assert (mine.abs().amax(dim=1) > 0.0).all()
    torch.testing.assert_close(mine, theirs, rtol=0.05, atol=0.05)


@pytest.mark.parametrize("part", ["people", "drifting", "road"])
def test_other_parts_are_captured_and_learn_what_they_learn_without_graphs(part, caplog):
    captured, _, mine = with_and_without_graphs(caplog, 1, **{part: True})
    assert part == "people" or mine[-1] < mine[0]
    assert part != "people" or captured.state.model.parts[1].shared["lattice"].abs().max() > 1e-4


@pytest.mark.parametrize("limits", [{}, {"fine_tune": 0.3, "geometry": 0.1}, {"geometry": 0.0}])
def test_scans_are_captured_and_learn_what_they_learn_without_graphs(limits, caplog, monkeypatch):
    """Of a sensor that moves while it turns, so that both halves of a revolution are rendered; by one graph."""
    moving = {"linear": np.array([3.0, 0.5, 0.0]), "angular": np.array([0.0, 0.0, 0.3])}
    recorded = [replace(scan_of_a_wall(x), seconds=x, **moving) for x in (0.5, 1.0, 1.5)]
    beside = ScanTrainingSettings(per_image=1.0, **limits)
    monkeypatch.setattr(captured_steps, "MEASURED_SCANS", 2)
    captured, eager, mine = with_and_without_graphs(caplog, 2, recorded=recorded, scans=beside)
    assert steps_of(captured) == steps_of(eager), "a replay that created a state again would count from 0"
    assert mine[-1] < mine[1], "scans"
    assert beside.fine_tune or mine[-2] < mine[0], "images, with which scans take turns unless they fine-tune"


def test_a_replayed_graph_reports_gradients_that_are_not_finite():
    trainer, _ = trained_with(True, iterations_done=10)
    assert trainer.steps.graphs._graphs
    trainer.state.model.parts[0].params["opacities"].data[0] = torch.nan
    with capture_stream(GPU):
        continued(trainer)
    with pytest.raises(TrainingError, match=r"iteration 11: .*gradient of background opacities"):
        trainer.state.guard.check("nowhere")


def test_captured_velocities_are_those_of_the_actors_that_own_the_gaussians_at_a_replay():
    actors = untrained_street(TrainSettings()).parts[1].to(GPU)

    def velocities() -> torch.Tensor:
        return actors.sample(actors.state(1.5, SCAN), SCAN).velocities

    with capture_stream(GPU):
        before = velocities()
        graph = capture(velocities, [], new_pool(), GPU, "velocities")
        assert graph is not None
        actors.params["owner"].fill_(1)
        graph.replay()
        after = velocities()
    assert torch.equal(graph.result, after) and not torch.equal(after, before)


def test_graphs_stay_valid_through_relocation_and_growth_into_preallocated_rows():
    """Gaussians that MCMC moves stay where they lie, and so do tensors that have room for more of them."""
    grows = {"mcmc": McmcSettings(noise_lr=0.0, refine_every=12), "refine_start": 0.0, "refine_stop": 0.9}
    settings = {"iterations": 60, "cap_max": 10_000, **grows}
    trainer, losses = trained_with(True, iterations_done=40, **settings)
    part = trainer.state.model.parts[0]
    count, known, preallocated = len(part), dict(trainer.steps.graphs._graphs), part.preallocated
    assert known and preallocated and losses[-1] < losses[0]
    with capture_stream(GPU):
        continued(trainer, 10)  # step 48 is among them
        assert len(part) > count and part.preallocated < preallocated and trainer.steps.graphs._graphs == known
        terms = continued(trainer, 10)
        assert part.preallocated == 0 and part.row_count == len(part), "densification has stopped"
    assert all(bool(torch.isfinite(value)) for value in terms.values())


def test_a_growing_training_learns_the_same_by_cuda_graphs(monkeypatch):
    monkeypatch.setattr(strategies, "GROWTH", 0.3)
    grows = {"mcmc": McmcSettings(noise_lr=0.0, refine_every=10), "refine_start": 0.0, "refine_stop": 1.0}
    (captured, mine), (eager, theirs) = (
        trained_with(capture, 60, cap_max=10_000, **grows) for capture in (True, False)
    )
    assert [len(part) for part in captured.state.model.parts] == [len(part) for part in eager.state.model.parts]
    assert captured.state.model.parts[0].preallocated and not eager.state.model.parts[0].preallocated
    assert mine[-1] == pytest.approx(theirs[-1], rel=0.1) and mine[-1] < 0.8 * mine[0]


def test_each_replay_drops_out_other_gaussians():
    model = untrained_street(settings_of()).to(GPU)
    sets = model.sample(model.states(0.5))
    before = concatenate(sets).opacities

    def dropped_out() -> torch.Tensor:
        return concatenate(with_dropout(sets, model, 0.5)).opacities

    with capture_stream(GPU), torch.no_grad():
        graph = capture(dropped_out, [], new_pool(), GPU, "dropout")
        assert graph is not None
        left_out = []
        for _ in range(3):
            graph.replay()
            left_out.append((graph.result != before).clone())
    torch.cuda.synchronize()
    assert all(a.any() and not torch.equal(a, b) for a, b in pairwise(left_out))
    trainer, losses = trained_with(True, dropout=0.1)
    assert len(trainer.steps.graphs._graphs) == 1 and losses[-1] < losses[0]


@pytest.mark.parametrize("degree", [0, 1])
def test_each_replay_mirrors_objects_at_random(degree, monkeypatch, caplog):
    """And a training with mirrored people is captured."""
    street, deformable = untrained_street, DeformableSettings(sh_degree=degree)

    def mirrored(*arguments, **named):
        model = street(*arguments, **named)
        model.parts[1].mirrored = torch.full((2,), 0.5)
        return model

    model = mirrored(settings_of(deformable=deformable), people=True)
    states = model.to(GPU).states(0.5)

    def shown() -> torch.Tensor:
        return model.sample(mirrored_at_random(model, states))[1].means

    torch.manual_seed(0)
    with capture_stream(GPU), torch.no_grad():
        shown()  # constants are made where nothing is captured
        graph = capture(shown, [], new_pool(), GPU, "mirrored")
        assert graph is not None
        places = set()
        for _ in range(40):
            graph.replay()
            places.add(round(float(graph.result.sum()), 3))
    assert len(places) == 4, "two objects, each on two sides"
    monkeypatch.setitem(globals(), "untrained_street", mirrored)
    trainer, losses = trained_with(True, people=True, deformable=deformable)
    assert not caplog.records, "nothing was refused"
    assert len(trainer.steps.graphs._graphs) == 1 and losses[-1] < losses[0]


def test_overflowed_lists_are_detected(monkeypatch):
    monkeypatch.setattr(capacity, "MIN_CAPACITY", 0)
    monkeypatch.setattr(capacity, "MARGIN", 1.0)
    trainer, _ = trained_with(True, iterations=8)
    trainer.state.model.parts[0].params["scales"].data += 1.0
    with capture_stream(GPU):
        continued(trainer, 4)
    assert any(map(overflowed, trainer.steps.graphs._graphs.values()))
    trainer.steps.graphs.check()
    assert not any(map(overflowed, trainer.steps.graphs._graphs.values()))
    monkeypatch.setattr(capacity, "MARGIN", 1.5)
    with capture_stream(GPU):
        continued(trainer, 2 * len(trainer.images.views))
    assert trainer.steps.graphs.enabled and len(trainer.steps.graphs._graphs) == 1


def test_a_training_that_cannot_be_captured_goes_on_without_graphs(monkeypatch, caplog):
    """As where a term of the loss asks the device something."""

    def counting(*args, terms=step_module.loss_terms):
        found = terms(*args)
        assert float(found["l1"]) >= 0.0
        return found

    monkeypatch.setattr(step_module, "loss_terms", counting)
    trainer, losses = trained_with(True, iterations=12)
    assert torch.rand(3, device=GPU).any(), "random numbers can still be drawn"
    (record,) = caplog.records
    assert record.message.startswith("iterations cannot be captured as a CUDA graph")
    assert not trainer.steps.graphs.enabled and losses[-1] < losses[0] and all(map(math.isfinite, losses))
