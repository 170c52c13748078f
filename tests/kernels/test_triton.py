"""Triton's kernels: each is what torch does, within rounding, and compiles for the GPUs there are.

Where there is no GPU they run in Triton's interpreter, see conftest.py.
"""

import dataclasses
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from gsplat.cuda._torch_impl import _eval_sh_bases_fast, _quat_scale_to_covar_preci
from helpers import REPOSITORY
from helpers.trainings import ALL_TERMS, guided_views, settings_of, untrained_street
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.kernels import triton as on_gpu
from drivesplat.model.harmonics import rotation_of_harmonics
from drivesplat.model.quaternions import left_factor, rotation_matrix
from drivesplat.model.sky import CubemapSky
from drivesplat.model.view import View
from drivesplat.settings.train import McmcSettings
from drivesplat.training.colours import masked_l1
from drivesplat.training.ssim import C1, C2, ssim_in_torch, weights
from drivesplat.training.trainer import Trainer

pytest.importorskip("triton", reason="Triton is not there for this system")
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def a_mask(height: int, width: int, seed: int, share: float = 0.2) -> torch.Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(size=(height, width)) < share).to(DEVICE)


@pytest.mark.parametrize(
    ("height", "width", "hidden", "moving"),
    [
        pytest.param(10, 45, True, True, id="wider than a block, rows that fill none"),
        pytest.param(10, 45, False, False, id="no masks"),
        pytest.param(3, 4, False, True, id="less than a window"),
    ],
)
def test_colours_differ_by_what_torch_says_and_pull_as_it_does(height, width, hidden, moving):
    from drivesplat.kernels.triton.colours import Window, colour_difference

    rng = np.random.default_rng(0)
    image, recorded = (torch.from_numpy(rng.uniform(0, 1, (height, width, 3))).float().to(DEVICE) for _ in range(2))
    pixels = (255 * recorded).to(torch.uint8)
    body = a_mask(height, width, 1) if hidden else None
    moves = a_mask(height, width, 2) if moving else None
    window = Window(torch.from_numpy(weights()).float().to(DEVICE), C1, C2)
    target, asked = pixels.float() / 255.0, image.clone().requires_grad_()
    seen = asked if body is None else torch.where(body[..., None], target, asked)
    expected = [F.l1_loss(seen, target), ssim_in_torch(seen, target)]
    expected.append(asked.new_zeros(()) if moves is None else masked_l1(seen, target, moves))
    found_for = image.clone().requires_grad_()
    found = colour_difference(found_for, pixels, body, moves, window)
    for name, mine, theirs in zip(("l1", "similarity", "moving"), found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5, msg=lambda said, name=name: f"{name}: {said}")
    torch.stack([weight * value for weight, value in zip((0.8, -0.2, 0.3), expected, strict=True)]).sum().backward()
    torch.stack([weight * value for weight, value in zip((0.8, -0.2, 0.3), found, strict=True)]).sum().backward()
    assert float(asked.grad.abs().max()) > 0.0
    torch.testing.assert_close(found_for.grad, asked.grad, atol=1e-8, rtol=1e-3)


def test_nothing_that_moves_is_no_difference():
    from drivesplat.kernels.triton.colours import Window, colour_difference

    image = torch.rand(4, 5, 3, device=DEVICE, requires_grad=True)
    window = Window(torch.from_numpy(weights()).float().to(DEVICE), C1, C2)
    nowhere = torch.zeros(4, 5, dtype=torch.bool, device=DEVICE)
    pixels = torch.zeros(4, 5, 3, dtype=torch.uint8, device=DEVICE)
    moving = colour_difference(image, pixels, None, nowhere, window)[2]
    moving.backward()
    assert float(moving.detach()) == 0.0 and not image.grad.any()


def test_adams_steps_are_torchs():
    from drivesplat.kernels.triton.adam import adam_step

    torch.manual_seed(0)
    theirs = torch.randn(700, 3, device=DEVICE)
    mine, rate = theirs.clone(), torch.tensor(0.02, device=DEVICE)
    states = {"exp_avg": torch.zeros_like(mine), "exp_avg_sq": torch.zeros_like(mine), "step": rate.new_zeros(())}
    adam = torch.optim.Adam([theirs], lr=0.02, eps=1e-15, fused=True)
    for step in range(25):
        theirs.grad = torch.randn_like(theirs) * 10.0 ** -(step % 7)
        rate.fill_(0.02 * 0.9**step)
        adam.param_groups[0]["lr"] = 0.02 * 0.9**step
        states["step"] += 1
        adam_step(mine, theirs.grad, states, rate, (0.9, 0.999), 1e-15)
        adam.step()
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("coefficients", [1, 4, 9])
def test_a_camera_sees_the_colours_that_gsplat_says(degree, coefficients):
    from drivesplat.kernels.triton.harmonics import seen_colours

    if degree == 1 and coefficients == 1:
        pytest.skip("there are none of that degree")
    torch.manual_seed(0)
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.random(random_state=0).as_matrix())
    pose[:3, 3] = torch.tensor([0.5, -1.0, 2.0])
    sizes = ((700, 3), (700, 1, 3), (700, coefficients - 1, 3))
    given = [torch.randn(size, device=DEVICE).requires_grad_() for size in sizes]
    basis = _eval_sh_bases_fast(coefficients, F.normalize(given[0] - pose[:3, 3].to(DEVICE), dim=1))
    used = (degree + 1) ** 2
    expected = (basis[:, :used, None] * torch.cat(given[1:], dim=1)[:, :used]).sum(dim=1) + 0.5
    found = seen_colours(*given, pose.to(DEVICE), degree)
    expected = expected.clamp(min=0.0)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    weights = torch.randn_like(expected)
    theirs = torch.autograd.grad(expected, given, weights, allow_unused=True, materialize_grads=True)
    mine = torch.autograd.grad(found, given, weights)
    for pulls in zip(mine, theirs, strict=True):
        torch.testing.assert_close(*pulls, atol=1e-4, rtol=1e-4)


def test_regularisers_hold_down_what_torch_says_and_as_much():
    from drivesplat.kernels.triton.regularisers import mean_opacity_and_scale

    torch.manual_seed(0)
    opacities, scales = torch.rand(1500, device=DEVICE), 5.0 * torch.rand(1500, 3, device=DEVICE)
    opacities[::3] = 0.0
    given = [opacities.requires_grad_(), scales.requires_grad_()]
    expected = opacities.mean(), (scales * (opacities.detach() > 0.0)[:, None]).mean()
    found = mean_opacity_and_scale(*given)
    torch.testing.assert_close(torch.stack(found), torch.stack(expected))
    pulls = [torch.autograd.grad(2.0 * opacity + 0.5 * scale, given) for opacity, scale in (expected, found)]
    for theirs, mine in zip(*pulls, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-9, rtol=1e-5)


@pytest.mark.parametrize("seed", range(4))
def test_the_sky_behind_is_that_of_torch_and_learns_as_much(seed):
    """Cameras that look every way: over edges and corners of the cube, too; a long lens sees few texels."""
    from drivesplat.kernels.triton.cube import Cube, before_cube

    torch.manual_seed(seed)
    sky = CubemapSky(9, torch.tensor([0.3, 0.5, 0.7]), 1e-2).to(DEVICE)
    texels = sky.params["texels"]
    texels.data += torch.randn_like(texels)
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    K = torch.tensor([[10.0, 0.0, 14.0], [0.0, 11.0, 6.0], [0.0, 0.0, 1.0]])
    K[:2, :2] *= (seed % 2) * 9.0 + 1.0
    view = View(K.to(DEVICE), pose.to(DEVICE), 29, 13, 0.0)
    splats, alpha = torch.rand(13, 29, 3, device=DEVICE), 0.99 * torch.rand(13, 29, 1, device=DEVICE)
    alpha[3:5] = 1.0
    given = [splats.requires_grad_(), alpha.requires_grad_(), texels]
    weighed = torch.randn(13, 29, 3, device=DEVICE)
    expected = splats + (1.0 - alpha) * sky.colors(view.rays())
    found = before_cube(splats, alpha, Cube(texels, sky.index), view.K, view.camera_to_world)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=0.0)
    pulls = [torch.autograd.grad((image * weighed).sum(), given) for image in (expected, found)]
    for theirs, mine in zip(*pulls, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-4)


def test_exploration_spreads_as_far_as_a_gaussian_reaches_and_less_where_it_is_seen():
    """By the covariance of many draws: strength² times that of the Gaussian, squared, of a faint one; an opaque one
    stays."""
    from drivesplat.kernels.triton.exploration import explore

    torch.manual_seed(0)
    count, strength, logit = 20_000, 2.0, -6.0
    rows = {"means": [5.0, -3.0, 1.0], "quats": [1.0, 0.3, -0.2, 0.5], "scales": [0.0, -1.0, -0.5]}
    params = nn.ParameterDict({name: nn.Parameter(torch.tensor(row).repeat(count, 1)) for name, row in rows.items()})
    params["opacities"] = nn.Parameter(torch.full((count,), logit))
    params["opacities"].data[count // 2 :] = 3.0
    params = params.to(DEVICE)
    explore(params, strength)
    moved = params["means"].detach().cpu().double() - torch.tensor(rows["means"])
    faint, opaque = moved[: count // 2], moved[count // 2 :]
    assert float(opaque.abs().max()) < 1e-5
    covariance = _quat_scale_to_covar_preci(params["quats"][:1], params["scales"][:1].exp(), True, False)[0][0]
    covariance = covariance.detach().cpu().double()
    fades = 1.0 / (1.0 + np.exp(100.0 * (1.0 / (1.0 + np.exp(-logit)) - 0.005)))
    expected = (strength * fades) ** 2 * covariance @ covariance.T
    torch.testing.assert_close(torch.cov(faint.T), expected, rtol=0.06, atol=0.01)
    assert float(faint.mean(dim=0).abs().max()) < 5.0 * float(expected.diagonal().max().sqrt()) / np.sqrt(count // 2)


def test_exploration_is_seeded():
    from drivesplat.kernels.triton.exploration import explore

    ends = []
    for seed in (1, 1, 2):
        params = nn.ParameterDict(
            {"means": torch.zeros(50, 3), "quats": torch.ones(50, 4), "scales": torch.zeros(50, 3)}
        ).to(DEVICE)
        params["opacities"] = torch.full((50,), -6.0, device=DEVICE)
        torch.manual_seed(seed)
        explore(params, 1.0)
        explore(params, 1.0)
        ends.append(params["means"].detach().clone())
    assert torch.equal(ends[0], ends[1]) and not torch.equal(ends[0], ends[2])


def some_objects(requires_grad: bool = True) -> tuple[Any, torch.Tensor, torch.Tensor]:
    """Five objects, one of them absent, two of other sizes; whose 150 Gaussians are, and the matrix of that."""
    from drivesplat.kernels.triton.placing import Objects

    quats = F.normalize(torch.randn(5, 4, device=DEVICE), dim=1).requires_grad_(requires_grad)
    translations = torch.randn(5, 3, device=DEVICE).requires_grad_(requires_grad)
    sizes, presence = torch.tensor([[1.0, 1.0, 2.0, 0.5, 1.0], [1.0, 0.0, 1.0, 1.0, 1.0]], device=DEVICE)
    owner = torch.randint(5, (150,), device=DEVICE)
    return Objects(quats, translations, sizes, presence), owner, F.one_hot(owner, 5).float()


def test_objects_are_placed_as_by_matrices_and_pull_alike():
    from drivesplat.kernels.triton.placing import Shapes, placed

    torch.manual_seed(0)
    shapes = Shapes(*(torch.randn(150, *size, device=DEVICE).requires_grad_() for size in ((3,), (4,), (3,), ())))
    objects, owner, owns = some_objects()
    rotations = rotation_matrix(objects.quats)[owner]
    sizes = objects.sizes[owner][:, None]
    expected = (
        (rotations @ (sizes * shapes.means)[..., None])[..., 0] + objects.translations[owner],
        (left_factor(objects.quats)[owner] @ F.normalize(shapes.quats, dim=-1)[..., None])[..., 0],
        sizes * torch.exp(shapes.scales),
        torch.sigmoid(shapes.opacities) * objects.presence[owner],
    )
    found = placed(shapes, objects, owner, owns)
    for theirs, mine in zip(expected, found, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5)
    weights, learned = [torch.randn_like(values) for values in expected], [*shapes, objects.quats, objects.translations]
    pulls = [torch.autograd.grad(values, learned, weights) for values in (expected, found)]
    for theirs, mine in zip(*pulls, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(("degree", "terms"), [(0, 5), (1, 5), (3, 2), (2, 1)])
def test_colours_in_time_are_summed_and_turned_and_learn_alike(degree, terms):
    from drivesplat.kernels.triton.colours_in_time import turned_colours

    torch.manual_seed(1)
    objects, owner, _ = some_objects(requires_grad=False)
    k, series = (degree + 1) ** 2, torch.randn(5, terms, device=DEVICE)
    turns = rotation_of_harmonics(rotation_matrix(objects.quats), k)
    sh0, shN = (torch.randn(150, terms, size, 3, device=DEVICE).requires_grad_() for size in (1, k - 1))
    expected = turns[owner] @ (series[owner][:, :, None, None] * torch.cat([sh0, shN], dim=2)).sum(dim=1)
    found = turned_colours(sh0, shN, series, turns, owner)
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    weights = torch.randn_like(expected)
    pulls = [torch.autograd.grad(values, [sh0, shN], weights) for values in (expected, found)]
    for theirs, mine in zip(*pulls, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5)


def stretch(model):
    """Makes Gaussians of what start as spheres, whose rotations would learn from rounding alone."""
    generator = torch.Generator().manual_seed(0)
    for part in model.parts:
        scales = part.params["scales"].data
        scales += 0.5 * torch.randn(scales.shape, generator=generator)


@pytest.mark.parametrize("body", [False, True])
def test_a_training_by_kernels_is_that_by_torch(body, monkeypatch):
    """Two iterations of background, cars and a cube map, with every term of the loss, and the own car's body."""
    ends = []
    for kernels in (True, False):
        monkeypatch.setattr(on_gpu, "for_tensor", lambda tensor, kernels=kernels: kernels)
        settings = settings_of(**ALL_TERMS, mcmc=McmcSettings(noise_lr=0.0), refine_start=1.0)
        model = untrained_street(settings)
        model.sky = CubemapSky(6, torch.full((3,), 0.5), 1e-2)
        stretch(model)
        views = guided_views(DEVICE)
        if body:
            own_car = torch.zeros_like(views[0].sky)
            own_car[-4:, 5:20] = True
            views = [dataclasses.replace(view, own_car=own_car) for view in views]
        before = {name: value.clone() for name, value in model.state_dict().items()}
        trainer = Trainer.begin(model.to(DEVICE), views, settings, 0, DEVICE)
        for _ in range(2):
            terms, picture, _ = trainer.fit_one()
            trainer.densify(picture)
        ends.append((terms, model.state_dict()))
    (terms, mine), (their_terms, theirs) = ends
    assert terms.keys() == their_terms.keys() and {"l1", "ssim", "dynamic", "sky_bce", "track_size"} <= terms.keys()
    for name, value in their_terms.items():
        torch.testing.assert_close(terms[name], value, atol=1e-5, rtol=1e-3)
    for name, value in theirs.items():  # Adam makes whole steps of rounding where a gradient is 0
        moved = (value.cpu() - before[name]).abs().float()
        if moved.any():
            apart = (mine[name] - value).abs().cpu()
            assert float(apart.quantile(0.7)) <= 0.01 * float(moved.max()), name
    assert (theirs["parts.1.params.means"].cpu() != before["parts.1.params.means"]).any()


COMPILED = """
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from drivesplat.kernels.triton import adam, chunks, colours, colours_in_time, cube, exploration, harmonics, placing
from drivesplat.kernels.triton import regularisers, tiles, trial

FLOATS, IN = "*fp32", {"pixels": "*u8", "hidden": "*i1", "moving": "*i1", "index": "*i64", "owner": "*i64",
              "ids": "*i32", "order": "*i64", "offsets": "*i32", "firsts": "*i32", "starts": "*i32", "there": "*i1",
              "radii": "*i32", "counts": "*i32", "nearest": "*i64", "ends": "*i32", "keys": "*i16"}
NUMBERS = dict.fromkeys(("height", "values", "width", "resolution", "count", "seed"), "i32")
NUMBERS |= dict.fromkeys(("tiles", "per_camera", "across", "steps", "room", "each"), "i32")
NUMBERS |= dict.fromkeys(("c1", "c2", "strength", "eps"), "fp32")
NUMBERS |= {f"{name}{i}": "fp32" for name in ("beta", "rest", "log_beta") for i in (1, 2)}
SIZES = {"TAPS": 11, "ROWS": colours.ROWS, "COLUMNS": colours.COLUMNS}

def compiled(kernel, **constants):
    kinds = {name: "constexpr" if name in constants else {**IN, **NUMBERS}.get(name, FLOATS)
             for name in kernel.arg_names}
    if kernel in (cube._blend, cube._gradients):
        kinds["pixels"] = "i32"
    if kernel in (adam._step, chunks._take_apart, chunks._composite, chunks._pull_apart):
        kinds["values"] = FLOATS
    places = {(kernel.arg_names.index(name),): value for name, value in constants.items()}
    source = ASTSource(fn=kernel, signature=kinds, constexprs=places)
    assert triton.compile(source, target=GPUTarget("cuda", 80, 32)).asm["cubin"], kernel

compiled(trial._count)
for k, degree in ((1, 0), (4, 1), (9, 0), (9, 1)):
    compiled(harmonics._colours, OTHERS=k - 1, DEGREE=degree, BLOCK=harmonics.BLOCK)
    compiled(harmonics._colours_back, OTHERS=k - 1, DEGREE=degree, BLOCK=harmonics.BLOCK)
compiled(adam._step, BLOCK=adam.BLOCK)
compiled(regularisers._sums, BLOCK=regularisers.BLOCK)
compiled(regularisers._spread, BLOCK=regularisers.BLOCK)
compiled(tiles._count_tiles, BLOCK=tiles.BLOCK)
compiled(tiles._list, BLOCK=tiles.BLOCK)
compiled(chunks._count_chunks, LENGTH=chunks.LENGTH, BLOCK=chunks.BLOCK)
for kernel in (chunks._take_apart, chunks._add_up):
    compiled(kernel, CHANNELS=3, LENGTH=chunks.LENGTH)
for kernel in (chunks._composite, chunks._pull_apart):
    compiled(kernel, CHANNELS=3, WIDTH=4)
compiled(exploration._move, BLOCK=exploration.BLOCK)
compiled(cube._blend, BLOCK=cube.BLOCK)
compiled(cube._gradients, BLOCK=cube.BLOCK)
compiled(placing._place, BLOCK=placing.BLOCK)
compiled(placing._place_back, BLOCK=placing.BLOCK)
for kernel in (colours_in_time._colours, colours_in_time._colours_back):
    for k in (1, 4, 16):
        compiled(kernel, TERMS=5, K=k, PADDED=k, BLOCK=colours_in_time.VALUES // k)
compiled(colours._window_along_rows, TAPS=11, BLOCK=colours.BLOCK)
compiled(colours._means_along_rows, HIDDEN=True, TAPS=11, BLOCK=colours.BLOCK)
compiled(colours._means_along_rows, HIDDEN=False, hidden=None, TAPS=11, BLOCK=colours.BLOCK)
for kernel in (colours._similarity, colours._gradient):
    compiled(kernel, HIDDEN=True, MOVING=True, **SIZES)
    compiled(kernel, HIDDEN=False, MOVING=False, hidden=None, moving=None, **SIZES)
"""


def test_every_kernel_compiles():
    """Which needs no card: it is what the interpreter does not try."""
    environment = {**os.environ, "TRITON_INTERPRET": "0"}
    done = subprocess.run([sys.executable, "-c", COMPILED], cwd=REPOSITORY, env=environment, capture_output=True)
    assert done.returncode == 0, done.stderr.decode()


@pytest.mark.parametrize("switch", ["0", "1"])
def test_what_triton_cannot_do_torch_does(switch, monkeypatch, caplog):
    """The user has switched it off, which needs no word; or it fails, which is told once."""
    from drivesplat.kernels.triton import trial

    def fail() -> None:
        raise RuntimeError("Failed to find C compiler.\nmore")

    monkeypatch.setenv(on_gpu.SWITCH, switch)
    monkeypatch.setattr(trial, "run", fail)
    on_gpu.compiles.cache_clear()
    try:
        assert not on_gpu.compiles() and not on_gpu.compiles()
        assert [record.message.count("Failed to find C compiler.") for record in caplog.records] == [1] * int(switch)
    finally:
        on_gpu.compiles.cache_clear()


def test_tensors_on_a_cpu_are_not_theirs():
    assert not on_gpu.for_tensor(torch.zeros(1))
