"""Densification on the CPU: the relocation formula, both strategies, and the cap."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from gsplat import MCMCStrategy
from gsplat.strategy import ops
from helpers.densification import ALL, a_model, a_view, settings_of, train_step
from helpers.hand_made import actors_of, motion_through, round_gaussians, track_of
from helpers.samples import sampled

from drivesplat.kernels.gsplat_private import cpu_strategies
from drivesplat.kernels.mcmc import explore, relocation
from drivesplat.model.actors import Actors
from drivesplat.model.gaussians import GaussianSets
from drivesplat.model.picture import Picture
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.train import CoarseToFineSettings, DefaultSettings, McmcSettings
from drivesplat.settings.train_objects import ActorSettings
from drivesplat.training import strategies
from drivesplat.training.densify import Densifier, coarse_cap
from drivesplat.training.loop import Trainer
from drivesplat.training.optimizers import make_optimizers
from drivesplat.training.schedule import Schedule

BINOMS = MCMCStrategy().initialize_state()["binoms"]
N_MAX = len(BINOMS)
SIZES = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": ()}
"""Of a Gaussian's parameters."""
"""Of a Gaussian's parameters."""


def equation_9(opacity: float, ratio: int) -> float:
    """By how much the scale shrinks: Kheradmand et al. 2024, equation 9, term by term."""
    new = 1.0 - (1.0 - opacity) ** (1.0 / ratio)
    terms = [
        math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1)
        for i in range(1, ratio + 1)
        for k in range(i)
    ]
    return opacity / math.fsum(terms)


def test_copies_are_together_as_opaque_as_the_original_and_scaled_by_equation_9():
    """Every Gaussian by its own ratio; those beyond the table are held at its ends."""
    pairs = [(o, n) for o in (0.02, 0.3, 0.9, 0.999) for n in (0, 1, 2, 3, 7, 20, N_MAX, N_MAX + 1, 10_000)]
    opacities, ratios = torch.tensor([o for o, _ in pairs]), torch.tensor([n for _, n in pairs])
    scales = torch.rand(len(pairs), 3, generator=torch.Generator().manual_seed(0)) + 0.1
    new_opacities, new_scales = relocation(opacities, scales, ratios, BINOMS)
    held = ratios.clamp(1, N_MAX)
    torch.testing.assert_close(1.0 - (1.0 - new_opacities.double()) ** held, opacities.double(), rtol=5e-4, atol=0)
    factors = torch.tensor([equation_9(o, int(n)) for (o, _), n in zip(pairs, held, strict=True)])
    torch.testing.assert_close(new_scales, scales * factors[:, None], rtol=5e-4, atol=0)


def test_gsplats_own_functions_are_restored_after_cpu_strategies():
    before = ops.compute_relocation, ops.quat_scale_to_covar_preci
    with pytest.raises(ZeroDivisionError), cpu_strategies():
        assert ops.compute_relocation is relocation
        raise ZeroDivisionError
    assert (ops.compute_relocation, ops.quat_scale_to_covar_preci) == before


@pytest.mark.parametrize("threads", [1, 2])
def test_exploration_on_a_cpu_is_gsplats(threads):
    """For more Gaussians than a chunk holds, of all sizes and opacities; their quaternions need not be of length 1."""
    count, random = 5000, torch.Generator().manual_seed(0)
    drawn = {name: torch.randn(count, *size, generator=random) for name, size in SIZES.items()}
    drawn["opacities"] -= 5.0
    moved, before = [], torch.get_num_threads()
    torch.set_num_threads(threads)
    for inject in (explore, lambda params, strength: ops.inject_noise_to_position(params, {}, {}, strength)):
        params = torch.nn.ParameterDict({name: torch.nn.Parameter(values.clone()) for name, values in drawn.items()})
        torch.manual_seed(3)
        with cpu_strategies():
            inject(params, 0.2)
        moved.append(params["means"].detach() - drawn["means"])
    torch.set_num_threads(before)
    torch.testing.assert_close(*moved, atol=1e-5, rtol=1e-3)
    assert moved[0].norm(dim=1).max() > 0.1 and params["means"].requires_grad


def densified(strategy: str, steps: int, count: int = 100, size: float = 0.05, **changes: Any) -> list[int]:
    """The number of Gaussians after every iteration."""
    torch.manual_seed(0)
    model, settings = a_model(count, size), settings_of(strategy, **changes)
    densifier, (optimizers,) = Densifier(model.parts[0], Schedule.of(settings, 1)), make_optimizers(model).parts
    counts = []
    for step in range(steps):
        train_step(model, densifier, step, optimizers)
        counts.append(len(model))
        assert {len(value) for value in model.parts[0].params.values()} == {counts[-1]}
        assert all(
            optimizers[name].param_groups[0]["params"][0] is value for name, value in model.parts[0].params.items()
        )
    return counts


def test_mcmc_adds_a_twentieth_at_a_time_up_to_the_cap():
    counts = densified("mcmc", 12, cap_max=118)
    assert counts == [100, 100, 105, 105, 110, 110, 115, 115, 118, 118, 118, 118]


@pytest.mark.parametrize(
    ("strategy", "fraction", "expected"),
    [("mcmc", 0.75, (750, 800 - 7 * 20)), ("mcmc", 1.0, (1000, 0)), ("default", 0.75, (1000, 0))],
)
def test_there_are_coarse_cap_in_time_to_become_all(strategy, fraction, expected):
    """A third more needs six times a twentieth, and another for what is rounded away."""
    coarse = CoarseToFineSettings(fraction=fraction)
    settings = settings_of(strategy, coarse_to_fine=coarse, refine_stop=0.8, mcmc=McmcSettings(refine_every=20))
    assert coarse_cap(1000, Schedule.of(settings, 1)) == expected


def test_while_images_are_reduced_the_cap_is_lower(monkeypatch):
    monkeypatch.setattr(strategies, "GROWTH", 0.5)
    model, settings = a_model(100), settings_of("mcmc", cap_max=200, mcmc=McmcSettings(refine_every=1))
    densifier, (optimizers,) = Densifier(model.parts[0], Schedule.of(settings, 1)), make_optimizers(model).parts
    counts = []
    for step, coarse in enumerate([True, True, False, False], start=2):
        train_step(model, densifier, step, optimizers, coarse)
        counts.append(len(model))
    assert counts == [120, 120, 180, 200]


def after_mcmc(model: SplatModel, step: int, cap_max: int, noise_lr: float = 0.0) -> None:
    """Densifies a model once, or between densifications adds noise alone."""
    settings = settings_of("mcmc", cap_max=cap_max, mcmc=McmcSettings(refine_every=2, noise_lr=noise_lr))
    (optimizers,) = make_optimizers(model).parts
    torch.manual_seed(0)
    Densifier(model.parts[0], Schedule.of(settings, 1)).after_step(step, optimizers, {}, ALL)


def test_mcmc_without_noise_or_growth_moves_dead_gaussians_onto_living_ones():
    part = (model := a_model()).parts[0]
    part.params["opacities"].data[:30] = -9.0
    living = part.params["means"].detach()[30:].clone()
    after_mcmc(model, 2, 100)
    assert len(model) == 100
    moved = part.params["means"].detach()[:30]
    assert ((moved[:, None] - living).abs().amax(dim=2).amin(dim=1) == 0).all()
    assert (sampled(part, 0.0).opacities > 0.005).all()


def test_relocation_hardly_changes_what_is_seen():
    """Copies of a Gaussian look like the one that was there, which the formula is made for."""
    model = a_model(size=0.12)
    with torch.no_grad():
        before = model.render(a_view(), 0).image
        after_mcmc(model, 2, 105)
        change = (model.render(a_view(), 0).image - before).abs()
    assert len(model) == 105
    assert float(change.max()) < 0.05 and float(change.mean()) < 0.002


def test_mcmc_noise_moves_faint_gaussians_more_than_opaque_ones():
    params = (model := a_model(size=0.2)).parts[0].params
    params["opacities"].data[:50], params["opacities"].data[50:] = -5.2, 6.0
    before = params["means"].detach().clone()
    after_mcmc(model, 1, 100, noise_lr=5e5)
    moved = (params["means"].detach() - before).norm(dim=1)
    assert float(moved[:50].mean()) > 1e-2 and float(moved[50:].max()) < 1e-6


@pytest.mark.parametrize("grows", [True, False])
def test_the_default_strategy_grows_where_the_image_pulls_more_than_its_threshold(grows):
    threshold = DefaultSettings(refine_every=2, grow_grad2d=1e-7 if grows else 1e3, prune_opacity=1e-3)
    counts = densified("default", 3, default=threshold)
    assert counts[:2] == [100, 100] and (counts[2] > 150 if grows else counts[2] == 100)


@pytest.mark.parametrize(
    ("cap_max", "size"),
    [(100, 0.05), pytest.param(117, 0.005, id="duplicated"), pytest.param(117, 0.05, id="split"), (250, 0.05)],
)
def test_the_default_strategy_never_exceeds_the_cap(cap_max, size):
    greedy = DefaultSettings(refine_every=2, grow_grad2d=1e-9, prune_opacity=1e-3)
    counts = densified("default", 9, size=size, cap_max=cap_max, default=greedy)
    assert max(counts) <= cap_max
    assert counts[-1] > 0.95 * cap_max, "it fills the cap, since all want to grow"


def screen_gradients(strengths: torch.Tensor) -> dict[str, Any]:
    """What a rendering would tell of Gaussians that pull so strongly across the screen."""
    centers = torch.zeros(1, len(strengths), 2, requires_grad=True)
    centers.grad = torch.stack([strengths, torch.zeros(len(strengths))], dim=1)[None]
    radii = torch.ones(1, len(strengths), 2, dtype=torch.int32)
    return {"means2d": centers, "radii": radii, "width": 32, "height": 24, "n_cameras": 1, "gaussian_ids": None}


def test_at_the_cap_the_default_strategy_prefers_the_largest_gradients():
    model = a_model(size=0.005)
    part, settings = model.parts[0], settings_of("default", cap_max=110)
    densifier, (optimizers,) = Densifier(part, Schedule.of(settings, 1)), make_optimizers(model).parts
    strength = torch.from_numpy(np.random.default_rng(2).permutation(100)).float() + 1.0
    before = part.params["means"].detach().clone()
    densifier.after_step(2, optimizers, screen_gradients(strength), ALL)
    assert len(part) == 110
    copies = torch.cdist(part.params["means"].detach()[100:], before).argmin(dim=1)
    assert set(copies.tolist()) == set(strength.topk(10).indices.tolist())


def test_the_default_strategy_removes_what_is_too_faint_and_resets_opacities_every_so_many_iterations():
    model = a_model()
    with torch.no_grad():
        model.parts[0].params["opacities"][:25] = math.log(0.004 / 0.996)
    default = DefaultSettings(refine_every=2, reset_every=3, grow_grad2d=1e3, prune_opacity=0.005)
    densifier = Densifier(model.parts[0], Schedule.of(settings_of("default", default=default), 1))
    (optimizers,) = make_optimizers(model).parts
    for optimizer in optimizers.values():
        optimizer.param_groups[0]["lr"] = 0.0
    brightest = []
    for step in range(1, 4):
        train_step(model, densifier, step, optimizers)
        brightest.append(float(sampled(model.parts[0], 0.0).opacities.detach().max()))
    assert len(model) == 75 and min(brightest[:2]) > 0.05
    assert brightest[2] == pytest.approx(0.01, rel=1e-3), "twice prune_opacity, as in 3DGS"


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
@pytest.mark.parametrize(("start", "stop"), [(0.5, 1.0), (0.0, 0.002)])
def test_nothing_is_densified_outside_its_span_of_iterations(strategy, start, stop):
    greedy = DefaultSettings(refine_every=2, grow_grad2d=1e-9, prune_opacity=1e-3)
    assert densified(strategy, 5, refine_start=start, refine_stop=stop, default=greedy) == [100] * 5


# ---- a model of several parts


def two_cars(count: int = 40, size: float = 0.05) -> Actors:
    """Two actors before the camera of `a_view`; each Gaussian's place within its box tells whose it is: those of the
    first are all behind their box's middle, those of the second all before it."""
    places = ([-1.0, 0.0, 4.0], [1.0, 0.0, 4.0])
    tracks = [track_of(motion_through([0.0, 0.5], [p, p]), str(i), (2.0, 2.0, 2.0)) for i, p in enumerate(places)]
    actors = actors_of(*tracks, count=count, settings=ActorSettings(cap_max=1000), shaken=False)
    with torch.no_grad():
        means = actors.params["means"]
        means[:, 0] = (0.2 + means[:, 0].abs()) * (2.0 * actors.params["owner"] - 1.0)
        actors.params["scales"].fill_(math.log(size))
    return actors


def owners_fit(actors: Actors) -> bool:
    """Whether every Gaussian is where its owner's are."""
    return torch.equal(actors.params["owner"], (actors.params["means"][:, 0] > 0).long())


def test_mcmc_gives_what_it_adds_and_moves_the_owner_of_where_it_goes():
    actors, settings = two_cars(), settings_of("mcmc")
    densifier = Densifier(actors, Schedule.of(settings, 1))
    (optimizers,) = make_optimizers(SplatModel([actors], None)).parts
    with torch.no_grad():
        actors.params["opacities"][:36] = -9.0  # all but four of the first car's
    torch.manual_seed(0)
    densifier.after_step(2, optimizers, {}, ALL)
    counts = actors.params["owner"].bincount().tolist()
    assert sum(counts) == len(actors) == 84 and counts[1] > 60, "most of the dead went over to the second car"
    assert owners_fit(actors)
    assert actors.params["owner"].dtype == torch.int64 and not actors.params["owner"].requires_grad


@pytest.mark.parametrize("size", [pytest.param(0.005, id="duplicated"), pytest.param(0.1, id="split")])
def test_the_default_strategy_gives_what_it_grows_its_parents_owner(size):
    actors = two_cars(size=size)
    growing = DefaultSettings(refine_every=2, grow_grad2d=1.0, prune_opacity=1e-3)
    densifier = Densifier(actors, Schedule.of(settings_of("default", default=growing), 1))
    (optimizers,) = make_optimizers(SplatModel([actors], None)).parts
    strengths = torch.zeros(80)
    strengths[30:50] = 1.0
    with torch.no_grad():
        actors.params["opacities"][:5] = -9.0
    torch.manual_seed(0)
    densifier.after_step(2, optimizers, screen_gradients(strengths), ALL)
    assert actors.params["owner"].bincount().tolist() == [45, 50], "ten of each grew, and five of the first were pruned"
    assert owners_fit(actors)


@pytest.mark.parametrize("wanting", [[3, 17, 29], [30, 44, 69], [0, 28, 31, 32, 60]])
def test_each_part_grows_by_the_gradients_of_its_own_rows(wanting):
    """The part that grows first must not shift whose gradients the second one's are."""
    model = SplatModel([round_gaussians(np.arange(90.0).reshape(30, 3), 0.001), two_cars(20, 0.001)], None)
    settings = settings_of("default", default=DefaultSettings(refine_every=2, grow_grad2d=1.0, prune_opacity=1e-3))
    trainer = Trainer.begin(model, [], settings, 0, torch.device("cpu"))
    trainer.state.step = 2
    strengths, nothing = torch.zeros(70), torch.zeros(24, 32, 3)
    strengths[wanting] = 1.0
    before, together = [len(part) for part in model.parts], model.at(0.0)
    trainer.densify(
        Picture(GaussianSets([together]), nothing, nothing, nothing[..., 0], None, screen_gradients(strengths))
    )
    grown = [sampled(part, 0.0)[count:] for part, count in zip(model.parts, before, strict=True)]
    assert torch.equal(torch.cat([new.means for new in grown]), together.means[wanting])
    assert len(grown[0]) == sum(row < 30 for row in wanting)


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_each_part_has_a_cap_of_its_own(strategy):
    greedy = DefaultSettings(refine_every=2, grow_grad2d=1e-9, prune_opacity=1e-3)
    settings = settings_of(strategy, cap_max=104, default=greedy)
    actors = two_cars()
    actors.cap_max = 82
    model = SplatModel([a_model().parts[0], actors], None)
    densifiers = [Densifier(part, Schedule.of(settings, 1)) for part in model.parts]
    optimizers = make_optimizers(model).parts
    torch.manual_seed(0)
    for densifier, own, of_part in zip(densifiers, optimizers, model.rows, strict=True):
        densifier.after_step(2, own, screen_gradients(torch.ones(180)), of_part)
    assert [len(part) for part in model.parts] == [104, 82]


@pytest.mark.parametrize("strategy", ["mcmc", "default"])
def test_a_part_without_gaussians_is_left_alone(strategy):
    model = SplatModel([round_gaussians([]), two_cars()], None)
    schedule, optimizers = Schedule.of(settings_of(strategy), 1), make_optimizers(model).parts
    densifier = Densifier(model.parts[0], schedule)
    densifier.after_step(2, optimizers[0], screen_gradients(torch.ones(80)), model.rows[0])
    assert len(model.parts[0]) == 0 and not densifier.any_alive()
