"""The CPU rasterizer against the reference, in plain torch; test_closed_forms.py compares it with closed forms."""

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from gsplat import DefaultStrategy
from helpers.agreement import differing
from helpers.patience import PATIENCE_S
from helpers.random_gaussians import Scene, random_scene
from helpers.reference_rasterizer import rasterize_reference

from drivesplat.kernels.numba import tiles
from drivesplat.rasterization import Rendering, rasterize

AGREEMENT = 1e-5
"""Maximum error in float64, relative to the tensor's maximum."""
INPUTS = ("means", "quats", "scales", "opacities", "colors", "viewmats")


def render(scene: Scene, backend: str = "cpu", **options) -> Rendering:
    rasterizer = {"cpu": rasterize, "reference": rasterize_reference}[backend]
    return rasterizer(**{f.name: getattr(scene, f.name) for f in fields(scene)}, **options)


def with_harmonics(scene: Scene, seed: int, degree: int) -> Scene:
    """The scene with coefficients for which some colors are negative, and rendered as 0."""
    shape = (len(scene.means), (degree + 1) ** 2, 3)
    return replace(scene, colors=0.5 * torch.from_numpy(np.random.default_rng(seed).normal(size=shape)))


def seen_and_gradients(scene: Scene, backend: str, **options) -> dict[str, torch.Tensor]:
    """Image, alpha, depth and radii, and the gradients of a fixed random weighting of the first three."""
    inputs = {name: getattr(scene, name).detach().clone().requires_grad_() for name in INPUTS}
    rendering = render(replace(scene, **inputs), backend, **options)
    rendering.info["means2d"].retain_grad()
    seen = {"image": rendering.image, "alpha": rendering.alpha}
    if rendering.depth is not None:
        seen["depth"] = rendering.depth
    generator = torch.Generator().manual_seed(1)
    weights = [torch.rand(v.shape, generator=generator, dtype=torch.float64).to(v) for v in seen.values()]
    torch.autograd.backward(list(seen.values()), weights)
    gradients = {f"gradient of {name}": value.grad for name, value in inputs.items()}
    gradients["gradient of means2d"] = rendering.info["means2d"].grad
    return {
        "radii": rendering.info["radii"].double(),
        **{name: value.detach() for name, value in {**seen, **gradients}.items()},
    }


def disagreements(scene: Scene, bound: float = AGREEMENT, **options) -> dict[str, float]:
    """The results that differ from the reference by more than `bound`, and their errors."""
    found, expected = (seen_and_gradients(scene, backend, **options) for backend in ("cpu", "reference"))
    return differing(found, expected, bound)


@contextmanager
def threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@pytest.mark.parametrize(("degree", "antialiased"), [(0, False), (1, True), (2, False), (3, True)])
def test_harmonics_of_each_degree_agree_in_several_cameras(degree, antialiased):
    scene = with_harmonics(random_scene(degree, n=70, width=39, height=22, cameras=2), degree, degree)
    scene.means[:6, 2] *= -1.0
    assert not disagreements(scene, sh_degree=degree, antialiased=antialiased, with_depth=True)
    if degree == 3:
        assert not disagreements(scene, sh_degree=1), "of fewer degrees than there are coefficients"


@pytest.mark.parametrize(
    ("channels", "with_depth", "antialiased"), [(1, True, True), (3, False, False), (7, True, False)]
)
def test_any_number_of_channels_agrees(channels, with_depth, antialiased):
    scene = random_scene(channels, n=60, width=37, height=21)
    scene.colors = torch.from_numpy(np.random.default_rng(channels).normal(size=(60, channels)))
    assert not disagreements(scene, with_depth=with_depth, antialiased=antialiased)


@pytest.mark.parametrize(("width", "height"), [(5, 3), (16, 32), (17, 50)])
def test_every_image_size_agrees(width, height):
    """Of cameras whose axes of the image are not at right angles, and whose principal point is beside the middle."""
    scene = random_scene(20, n=50, width=width, height=height)
    scene.Ks[:, 0, 1], scene.Ks[:, 0, 2] = 0.7, 0.1 * width
    assert not disagreements(scene, with_depth=True)


@pytest.mark.parametrize("antialiased", [False, True])
def test_extreme_gaussians_agree(antialiased):
    """Points, giants, needles and sheets; a zero quaternion; faint and opaque; beside, behind and at the camera."""
    scene = random_scene(30, n=64, width=40, height=30)
    s = scene.scales
    s[:8], s[8:16], s[16:24, 1:], s[24:32, 0], s[32] = 1e-6, 30.0, 1e-3, 1e-3, 0.0
    s[16:24, 0] = 3.0
    scene.quats[33] = 0.0
    scene.opacities[34:38] = torch.tensor([0.0, 1.001 / 255.0, 0.999 / 255.0, 1.0])
    scene.means[40:46] = torch.tensor(
        [[50.0, 0.0, 3.0], [0.0, -80.0, 2.0], [0.0, 0.0, 0.005], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.1, 0.1, 0.012]]
    )
    assert not disagreements(scene, antialiased=antialiased, with_depth=True)


def test_equal_depths_keep_their_order():
    """As in gsplat's stable sort. The reference's sort is not stable, so its depths differ slightly."""
    scene = random_scene(31, n=60, width=30, height=30)
    scene.viewmats = torch.eye(4, dtype=torch.float64)[None]
    scene.means[:, 2] = 4.0
    found = render(scene).image
    scene.means[:, 2] += 1e-12 * torch.arange(60, dtype=torch.float64)
    torch.testing.assert_close(found, render(scene, "reference").image, rtol=0.0, atol=1e-8)


def test_rays_that_end_early_agree():
    """With opaque Gaussians in many layers most lists are not processed to their end."""
    scene = random_scene(32, n=200, width=33, height=20)
    scene.opacities[:] = torch.linspace(0.6, 1.0, 200)
    assert not disagreements(scene, with_depth=True)


def test_the_number_of_windows_does_not_change_an_image(monkeypatch):
    scene = random_scene(34, n=80, width=70, height=40)
    whole = seen_and_gradients(scene, "cpu")
    monkeypatch.setattr(tiles, "MAX_ENTRIES", 40)
    splats = tiles.front_to_back(*_projected(scene))
    windows = list(tiles.tile_lists(splats, *tiles.grid(70, 40)))
    assert len(windows) > 2
    assert all(len(w.ranks) <= 40 for w in windows)
    for name, value in seen_and_gradients(scene, "cpu").items():
        torch.testing.assert_close(value, whole[name], rtol=1e-12, atol=1e-14)


def _projected(scene: Scene) -> list[np.ndarray]:
    info = render(scene).info
    names = ("means2d", "depths", "conics", "opacities", "radii")
    return [*(info[name][0].numpy() for name in names), scene.colors.numpy()]


@pytest.mark.parametrize("n", [0, 1])
def test_without_a_gaussian_in_view_image_and_gradients_are_zero(n):
    scene = random_scene(35, n=1, width=20, height=18, cameras=2)
    scene.means[:, 2] = -5.0
    scene = replace(scene, **{name: getattr(scene, name)[:n] for name in INPUTS[:-1]})
    found = seen_and_gradients(with_harmonics(scene, 0, 2), "cpu", sh_degree=2, with_depth=True, antialiased=True)
    assert found["image"].shape == (2, 18, 20, 3)
    assert found["gradient of means"].shape == (n, 3)
    assert all((value == 0).all() for value in found.values())


def test_float32_agrees_except_for_gaussians_at_the_cut_off():
    scene = with_harmonics(random_scene(36, n=150, width=48, height=32, cameras=2), 36, degree=3)
    expected = seen_and_gradients(scene, "cpu", sh_degree=3, antialiased=True)
    found = seen_and_gradients(scene.float(), "cpu", sh_degree=3, antialiased=True)
    for name, truth in expected.items():
        if name != "radii":
            assert found[name].dtype == torch.float32
            error = (found[name] - truth).abs().flatten() / truth.abs().max()
            assert float(error.quantile(0.99)) < 1e-4 and float(error.max()) < 1e-2, name


def test_a_black_color_has_a_gradient():
    """Its harmonics are exactly 0, the limit of the range with gradients."""
    scene = random_scene(37, n=10, width=20, height=20)
    scene.colors = torch.full((10, 1, 3), -1.0, dtype=torch.float64) * np.sqrt(np.pi)
    gradient = seen_and_gradients(scene, "cpu", sh_degree=0)["gradient of colors"]
    assert (gradient > 0).any()


def test_too_few_coefficients_for_the_degree_are_an_error():
    scene = with_harmonics(random_scene(38, n=5, width=8, height=8), 0, degree=1)
    with pytest.raises(ValueError, match=r"degree 2 from 4 coefficients"):
        render(scene, sh_degree=2)


def test_results_are_bitwise_equal_for_every_run_and_number_of_threads():
    scene = with_harmonics(random_scene(39, n=2500, width=90, height=70), 39, degree=2).float()
    scene.scales = scene.scales * 0.3
    results = []
    for count in (1, 2, 2, 3):
        with threads(count):
            results.append(seen_and_gradients(scene, "cpu", sh_degree=2, with_depth=True))
    assert all(torch.equal(found[name], value) for found in results[1:] for name, value in results[0].items())


def test_info_equals_the_references():
    scene = random_scene(41, n=40, width=32, height=24, cameras=2)
    expected, found = (render(scene, backend, antialiased=True).info for backend in ("reference", "cpu"))
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        if isinstance(value, torch.Tensor):
            torch.testing.assert_close(found[name], value, check_dtype=True)
        else:
            assert found[name] == value


@pytest.mark.parametrize("absgrad", [False, True])
def test_gsplats_default_strategy_reads_info(absgrad):
    scene = random_scene(12, n=20, width=32, height=24).float()
    scene.means[3, 2] = -4.0
    params = {name: torch.nn.Parameter(getattr(scene, name)) for name in INPUTS[:4]}
    rendering = render(replace(scene, **params), absgrad=absgrad)
    strategy = DefaultStrategy(refine_stop_iter=1000, absgrad=absgrad)
    state = strategy.initialize_state()
    strategy.step_pre_backward(params, {}, state, 1, rendering.info)
    rendering.image.square().sum().backward()
    strategy.step_post_backward(params, {}, state, 1, rendering.info)
    seen = (rendering.info["radii"][0] > 0).all(dim=-1)
    assert not seen[3] and seen.sum() > 10
    means2d = rendering.info["means2d"]
    in_screen = (means2d.absgrad if absgrad else means2d.grad)[0] * torch.tensor([16.0, 12.0])
    torch.testing.assert_close(state["grad2d"], in_screen.norm(dim=-1) * seen)
    assert (state["grad2d"][seen] > 0).sum() > 10


def test_absgrad_is_the_sum_over_pixels_of_absolute_gradients():
    scene = random_scene(42, n=6, width=18, height=3, cameras=2)  # two tiles
    scene.means.requires_grad_()

    def rendering_and_loss(backend: str, **options) -> tuple[Rendering, torch.Tensor]:
        rendering = render(scene, backend, antialiased=True, **options)
        return rendering, rendering.image.square().sum(dim=-1)

    reference, losses = rendering_and_loss("reference")
    expected = torch.zeros_like(reference.info["means2d"])
    for loss in losses.flatten():
        expected += torch.autograd.grad(loss, reference.info["means2d"], retain_graph=True)[0].abs()
    found, losses = rendering_and_loss("cpu", absgrad=True)
    losses.sum().backward()
    assert expected.max() > 0
    torch.testing.assert_close(found.info["means2d"].absgrad, expected)


def test_several_threads_can_render_at_the_same_time():
    scene = with_harmonics(random_scene(43, n=500, width=64, height=48), 43, degree=1)
    expected = seen_and_gradients(scene, "cpu", sh_degree=1)
    found: list[dict[str, torch.Tensor]] = []

    def work() -> None:
        with threads(2):
            found.extend(seen_and_gradients(scene, "cpu", sh_degree=1) for _ in range(3))

    workers = [threading.Thread(target=work) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=PATIENCE_S)
    assert len(found) == 9
    assert all(torch.equal(value, seen[name]) for seen in found for name, value in expected.items())


def _image_in_child(scene: Scene, connection) -> None:
    torch.set_num_threads(2)
    connection.send(render(scene).image.numpy())


@pytest.mark.filterwarnings("ignore:.*multi-threaded.*fork:DeprecationWarning")
def test_a_process_forked_after_rendering_can_render():
    scene = random_scene(44, n=500, width=64, height=48)
    with threads(2):
        expected = render(scene).image.numpy()
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    child = context.Process(target=_image_in_child, args=(scene, there))
    child.start()
    try:
        assert here.poll(PATIENCE_S), "the forked process hangs or has died"
        np.testing.assert_array_equal(here.recv(), expected)
    finally:
        child.kill()
        child.join()


@pytest.mark.slow
def test_kernels_compile_where_numba_cannot_write_its_cache():
    """With a read-only installation and home each process compiles again."""
    script = """
import numpy as np
from numba.core import caching

def unwritable(self):
    raise OSError("read-only")

for locator in (caching._CacheLocator, *caching._CacheLocator.__subclasses__()):
    locator.ensure_cache_path = unwritable
from helpers.reference_rasterizer import rasterize_reference

from drivesplat.kernels.numba.tiles import _sorted_by
print(_sorted_by(np.arange(3, dtype=np.int32), np.array([2, 0, 1], np.uint32)).tolist())
"""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=PATIENCE_S
    )
    assert done.stdout.strip() == "[1, 2, 0]", done.stderr
