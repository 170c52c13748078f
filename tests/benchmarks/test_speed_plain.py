"""The plain recipe follows gsplat's example trainer in its configuration `mcmc`."""

import math

import numpy as np
import pytest
import torch
from helpers.records import training_record_of
from helpers.reference_rasterizer import rasterize_reference
from PIL import Image
from skimage.metrics import structural_similarity

from benchmarks.speed.plain import (
    VARIANTS,
    PlainRecipe,
    Schedule,
    as_model,
    init_splats,
    make_optimizers,
    make_sky,
    scene_scale,
)
from benchmarks.speed.plain_images import ImageFiles, endless, loader_of
from benchmarks.speed.plain_ssim import Ssim, chosen_ssim, torch_ssim
from benchmarks.speed.plain_training import PlainTraining, fit
from drivesplat.io.checkpoint_file import load
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train import TrainSettings

pytestmark = pytest.mark.usefixtures("one_thread")
CPU = torch.device("cpu")
WIDTH, HEIGHT = 32, 24


@pytest.fixture
def record(tmp_path) -> TrainingRecord:
    """Five images of a wall of dots by a camera that drives along it, the fourth held out, and 60 seed points."""
    rng = np.random.default_rng(0)
    paths, poses = [], np.tile(np.eye(4), (5, 1, 1))
    for i in range(5):
        poses[i, 0, 3] = 0.2 * i
        paths.append(str(tmp_path / f"{i}.png"))
        Image.fromarray(rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)).save(paths[-1])
    return training_record_of(
        5,
        Ks=np.tile([[20.0, 0.0, WIDTH / 2], [0.0, 20.0, HEIGHT / 2], [0.0, 0.0, 1.0]], (5, 1, 1)),
        camtoworlds=poses,
        image_paths=paths,
        image_sizes=np.tile([WIDTH, HEIGHT], (5, 1)),
        points=rng.uniform([-2.0, -1.5, 3.0], [3.0, 1.5, 5.0], (60, 3)),
        points_rgb=rng.integers(0, 256, (60, 3), dtype=np.uint8),
        scene_scale=0.4,
        splits={"train": np.array([0, 1, 2, 4]), "interpolation": np.array([3])},
    )


def begun(record: TrainingRecord, recipe: PlainRecipe, ssim: Ssim | None = None) -> PlainTraining:
    splats = init_splats(record.points, record.points_rgb, recipe.seed)
    optimizers = make_optimizers(splats, scene_scale(record))
    return PlainTraining(splats, optimizers, recipe, CPU, ssim or chosen_ssim(CPU))


def images_of(record: TrainingRecord) -> ImageFiles:
    return ImageFiles(record, [record.image_paths[i] for i in record.splits["train"]])


def test_the_schedule_and_densification_are_those_of_the_example():
    schedule = Schedule.of(30_000)
    assert schedule == Schedule(30_000, sh_every=1_000, refine_start=500, refine_stop=25_000)
    assert [schedule.sh_degree(step) for step in (0, 999, 1_000, 2_999, 3_000, 29_999)] == [0, 0, 1, 2, 3, 3]
    for iterations, start, stop in ((30_000, 500, 25_000), (15_000, 250, 12_500)):
        strategy = PlainRecipe(Schedule.of(iterations), cap_max=1234, seed=0).strategy()
        actual = (strategy.cap_max, strategy.refine_start_iter, strategy.refine_stop_iter, strategy.refine_every)
        assert actual == (1234, start, stop, 100)
        assert (strategy.noise_lr, strategy.min_opacity) == (5e5, 0.005)


def test_gaussians_begin_small_and_half_opaque_at_the_seed_points(record):
    """Opacity 0.5; a tenth of the root mean square distance to three neighbours; the colour at degree 0."""
    splats = init_splats(record.points, record.points_rgb, seed=0)
    distances = np.linalg.norm(record.points[:, None] - record.points[None], axis=2)
    nearest = np.sort(distances, axis=1)[:, 1:4]
    assert torch.allclose(splats["means"], torch.from_numpy(record.points).float())
    expected = 0.1 * np.sqrt((nearest**2).mean(axis=1))
    assert np.allclose(torch.exp(splats["scales"]).detach().numpy(), expected[:, None], rtol=1e-5)
    assert torch.allclose(torch.sigmoid(splats["opacities"]), torch.tensor(0.5))
    shown = 0.5 + splats["sh0"][:, 0].detach().numpy() / (2.0 * math.sqrt(math.pi))
    assert np.allclose(shown, record.points_rgb / 255.0, atol=1e-6)
    assert splats["shN"].shape == (60, 15, 3) and not splats["shN"].any()


def test_ssim_uses_only_windows_fully_inside_the_image():
    rng = np.random.default_rng(1)
    a = rng.random((40, 50, 3))
    b = (a + rng.normal(scale=0.1, size=a.shape)).clip(0, 1)
    _, full = structural_similarity(
        a, b, data_range=1.0, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False, full=True
    )
    batches = [torch.from_numpy(image).permute(2, 0, 1)[None] for image in (a, b)]
    assert float(torch_ssim(*batches)) == pytest.approx(full[5:-5, 5:-5].mean(), abs=1e-6)


def test_the_loss_equals_that_of_the_mcmc_example(record):
    """0.8 L1 + 0.2 (1 - SSIM) + 0.01 mean opacity + 0.01 mean scale, for a black background and degree 0."""
    training = begun(record, PlainRecipe(Schedule.of(30_000), 60, 0))
    batch = next(endless(loader_of(images_of(record), 0, CPU)))
    terms, _ = training.training_step(iter([batch]))
    s = {name: value.detach() for name, value in training.splats.items()}
    scales, opacities = torch.exp(s["scales"]), torch.sigmoid(s["opacities"])
    viewmat = torch.linalg.inv(batch["camtoworld"])
    image = rasterize_reference(
        s["means"], s["quats"], scales, opacities, s["sh0"], viewmat, batch["K"], WIDTH, HEIGHT, sh_degree=0,
    ).image  # fmt: skip
    pixels = batch["image"] / 255.0
    similarity = torch_ssim(image.permute(0, 3, 1, 2), pixels.permute(0, 3, 1, 2))
    expected = 0.8 * (image - pixels).abs().mean() + 0.2 * (1.0 - similarity) + 0.01 * (0.5 + scales.mean())
    assert float(terms["loss"].detach()) == pytest.approx(float(expected), rel=1e-4)
    assert all(value.grad is not None for name, value in training.splats.items() if name != "shN")


def test_learning_rates_are_those_of_the_example_and_that_of_means_and_the_noise_decay(record, monkeypatch):
    """The final rate is 1% of the initial one. A step's noise uses the next step's rate, as in the example."""
    actual, first = [], 1.6e-4 * 1.1 * 0.4

    def noted(self, params, optimizers, state, step, info, lr):
        actual.append((step, lr))

    monkeypatch.setattr("benchmarks.speed.plain.MCMCStrategy.step_post_backward", noted)
    training = begun(record, PlainRecipe(Schedule.of(10), 60, 0))
    rates = {name: optimizer.param_groups[0]["lr"] for name, optimizer in training.optimizers.items()}
    assert rates == pytest.approx(
        {"means": first, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
    )
    for optimizer in training.optimizers.values():
        assert isinstance(optimizer, torch.optim.Adam)
        assert (optimizer.defaults["eps"], optimizer.defaults["betas"]) == (1e-15, (0.9, 0.999))
    data = endless(loader_of(images_of(record), 0, CPU))
    for step in range(10):
        assert training.optimizers["means"].param_groups[0]["lr"] == pytest.approx(first * 0.01 ** (step / 10))
        training.learn(training.training_step(data)[1])
    assert [step for step, _ in actual] == list(range(10))
    assert [lr for _, lr in actual] == pytest.approx([first * 0.01 ** (step / 10) for step in range(1, 11)])
    assert training.optimizers["scales"].param_groups[0]["lr"] == 5e-3


def test_the_training_converges_reaches_its_cap_and_writes_a_measurable_model(record, tmp_path):
    splats = init_splats(record.points, record.points_rgb, seed=0)
    schedule = Schedule(220, sh_every=1, refine_start=0, refine_stop=220)
    before = as_model({name: value.detach().clone() for name, value in splats.items()}, scene_scale(record))
    recipe = PlainRecipe(schedule, 64, 0, workers=0)
    summary = fit(splats, images_of(record), scene_scale(record), recipe, tmp_path / "out")
    assert (summary.gaussians, summary.peak_gpu_memory_gb, summary.ssim) == (64, None, "torch")
    assert len(splats["means"]) == 64, "60, 63 after 100 iterations, 64 after 200"
    assert summary.seconds > 0
    kept = load(tmp_path / "out/ckpt.npz", rule="train")
    assert kept["step"] == 220 and torch.equal(kept["splats"]["means"], splats["means"])
    after = as_model(kept["splats"], scene_scale(record))
    assert after.sky is None and off(after, record) < 0.7 * off(before, record)


@pytest.mark.gpu
@pytest.mark.parametrize("name", ["plain", "plain_packed"])
def test_packed_only_visible_gaussians_learn(record, name, tmp_path):
    """The first Gaussian is behind every camera: the mean opacity alone would change it."""
    splats = init_splats(record.points, record.points_rgb, seed=0).to("cuda")
    with torch.no_grad():
        splats["means"][0] = torch.tensor([0.0, 0.0, -50.0])
    before = splats["opacities"].detach().clone()
    recipe = PlainRecipe(Schedule(50, sh_every=1, refine_start=0, refine_stop=50), 64, 0, 0, VARIANTS[name])
    fit(splats, images_of(record), scene_scale(record), recipe, tmp_path)
    changed = splats["opacities"].detach() != before
    assert bool(changed[0]) == (name == "plain") and changed[1:].float().mean() > 0.5


@pytest.mark.gpu
@pytest.mark.parametrize("name", [*VARIANTS])
def test_on_a_gpu_it_trains_with_gsplats_own_rasterizer(record, name, tmp_path):
    splats = init_splats(record.points, record.points_rgb, seed=0).to("cuda")
    schedule = Schedule(120, sh_every=1, refine_start=0, refine_stop=120)
    recipe, sky = PlainRecipe(schedule, 64, 0, 2, VARIANTS[name]), make_sky(VARIANTS[name], TrainSettings())
    before = torch.cuda.memory_reserved() / 1e9  # by other tests' recordings, whose memory torch does not give back
    sky = None if sky is None else sky.to("cuda")
    summary = fit(splats, images_of(record), scene_scale(record), recipe, tmp_path, sky=sky)
    assert summary.gaussians == 63 and 0 < summary.peak_gpu_memory_gb < before + 1
    assert all(torch.isfinite(value).all() for value in load(tmp_path / "ckpt.npz", rule="train")["splats"].values())


def off(model, record: TrainingRecord) -> float:
    """Mean absolute error of a model's rendering of the first image."""
    from drivesplat.model.view import View

    pose, intrinsics = (torch.from_numpy(getattr(record, key)[0]).float() for key in ("camtoworlds", "Ks"))
    with torch.no_grad():
        image = model.render(View(intrinsics, pose, WIDTH, HEIGHT, 0.0)).image
    recorded = np.asarray(Image.open(record.image_paths[0])) / 255.0
    return float(np.abs(image.numpy() - recorded).mean())
