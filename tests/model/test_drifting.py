"""Drifting Gaussians: where they are and how opaque at any time, their seed, densification, checkpoint, exports, and a
fit of what moves."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made import looking_at
from helpers.records import training_record_of
from helpers.samples import sampled

from drivesplat.model.background import Background
from drivesplat.model.build import ModelInit, build_model
from drivesplat.model.drifting import Drifting, DriftingSeed, drifting_seed, ego_velocities
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN
from drivesplat.model.view import View
from drivesplat.rasterization import rasterize
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.drifting import DriftingSeedSettings, DriftingSettings
from drivesplat.settings.train import GaussianSettings, McmcSettings, TrainSettings
from drivesplat.training import strategies
from drivesplat.training.densify import Densifier
from drivesplat.training.loop import Trainer
from drivesplat.training.optimizers import make_optimizers
from drivesplat.training.schedule import Schedule
from drivesplat.training.views import TrainingView

COUNT = 7
SECONDS = (0.5, 6.5)
"""The times of the first and the last training image."""


def a_seed(count: int = COUNT) -> DriftingSeed:
    rng = np.random.default_rng(0)
    return DriftingSeed(
        positions=rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (count, 3)),
        velocities=rng.normal(size=(count, 3)) * [4.0, 4.0, 0.5],
        peaks=rng.uniform(1.0, 6.0, count),
        colors=rng.uniform(0.1, 0.9, (count, 3)),
        scales=rng.uniform(0.05, 0.3, count),
    )


def drifting(settings: DriftingSettings | None = None, count: int = COUNT, **more: object) -> Drifting:
    """Gaussians with life spans and rotations that differ."""
    own = settings or DriftingSettings()
    part = Drifting.from_seed(a_seed(count), own, GaussianSettings(), 5.0, SECONDS, **more)
    generator = torch.Generator().manual_seed(1)
    for name in ("spans", "quats", "opacities", "shN"):
        value = part.params[name].data
        value += 0.5 * torch.randn(value.shape, generator=generator)
    return part


def numpy_of(part: Drifting) -> dict[str, np.ndarray]:
    return {name: value.detach().double().numpy() for name, value in part.params.items()}


def expected_at(part: Drifting, time: float, min_span: float) -> tuple[np.ndarray, np.ndarray]:
    """Centres and opacities by the formulas of PVG with a long cycle, one Gaussian at a time."""
    p, centres, opacities = numpy_of(part), [], []
    for i in range(len(p["means"])):
        beta = min_span + np.exp(p["spans"][i])
        age = min(max(time, SECONDS[0]), SECONDS[1]) - p["peaks"][i]
        life = np.exp(-0.5 * (age / beta) ** 2) if abs(age) < 3.0 * beta else 0.0
        centres.append(p["means"][i] + (time - p["peaks"][i]) * p["velocities"][i])
        opacities.append(life / (1.0 + np.exp(-p["opacities"][i])))
    return np.array(centres), np.array(opacities)


@pytest.mark.parametrize("time", [-1.0, 2.3, 8.0])
def test_a_gaussian_moves_at_its_velocity_and_is_most_opaque_at_its_life_peak(time):
    """Beyond the training images it goes on, but neither appears nor fades."""
    part = drifting(DriftingSettings(min_span=0.4))
    found = sampled(part, time)
    centres, opacities = expected_at(part, time, 0.4)
    np.testing.assert_allclose(found.means.detach(), centres, atol=1e-5)
    np.testing.assert_allclose(found.opacities.detach(), opacities, atol=1e-6)
    assert opacities.any()


def test_a_gaussian_is_absent_long_before_and_after_its_life_peak():
    part = drifting(DriftingSettings(min_span=0.1), count=1)
    part.params["spans"].data.fill_(-30.0)
    torch.testing.assert_close(part.life_spans.detach(), torch.full((1,), 0.1))
    part.params["spans"].data.fill_(np.log(0.2))
    part.params["peaks"].data.fill_(3.0)
    shown = [float(sampled(part, 3.0 + age).opacities[0].detach()) for age in (-0.95, -0.85, 0.0, 0.85, 0.95)]
    assert shown[0] == shown[-1] == 0.0 and 0.0 < shown[1] < 0.02 * shown[2] and shown[3] > 0.0


def test_velocities_are_differences_of_positions():
    part = drifting().double()
    step = 1e-3
    difference = (sampled(part, 2.0 + step).means - sampled(part, 2.0 - step).means) / (2.0 * step)
    velocities = sampled(part, 2.0, SCAN).velocities
    torch.testing.assert_close(velocities, difference.detach(), atol=1e-6, rtol=1e-6)
    assert not velocities.requires_grad


def test_gradients_are_those_of_differences():
    part = drifting(count=4).double()
    weights = torch.randn(4, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def shown() -> torch.Tensor:
        found = sampled(part, 3.0)
        return (found.means * weights).sum() + found.opacities.square().sum()

    shown().backward()
    for name in ("means", "velocities", "peaks", "spans", "opacities"):
        value, step = part.params[name], 1e-6
        assert value.grad is not None and value.grad.any(), name
        for index in np.ndindex(*value.shape):
            ends = []
            for sign in (1.0, -1.0):
                value.data[index] += sign * step
                ends.append(float(shown().detach()))
                value.data[index] -= sign * step
            assert (ends[0] - ends[1]) / (2.0 * step) == pytest.approx(float(value.grad[index]), abs=1e-5), name


def test_what_scans_may_not_change_freely_is_all_that_places_and_opacities_follow_from():
    part = drifting(lidar_logits=(0.3, 0.9))
    found = sampled(part, 3.0)
    (found.means.sum() + found.quats.sum() + found.scales.sum() + found.opacities.sum()).backward()
    assert {name for name, value in part.params.items() if value.grad is not None} == set(part.geometry)


# ---- the seed


def driven(speed: float = 8.0, images: int = 9) -> TrainingRecord:
    """Images of a camera 1.5 m above the ground, at -2 m, that looks along the world's x axis, in which it drives."""
    times = 0.5 * np.arange(images)
    ego = np.tile(np.eye(4), (images, 1, 1))
    ego[:, 0, 3], ego[:, 2, 3] = speed * times, -2.0
    camera = ego.copy()
    camera[:, :3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    camera[:, 2, 3] += 1.5
    return dataclasses.replace(
        training_record_of(images),
        Ks=np.tile([[50.0, 0.0, 50.0], [0.0, 50.0, 25.0], [0.0, 0.0, 1.0]], (images, 1, 1)),
        camtoworlds=camera,
        ego_to_world=ego,
        timestamps=(1e6 * times).astype(np.int64),
        image_sizes=np.tile([100, 50], (images, 1)),
        splits={"train": np.arange(1, images - 1), "interpolation": np.array([0, images - 1])},
    )


def test_seeds_are_before_a_camera_near_the_ground_and_live_when_it_looks():
    record, settings = driven(), DriftingSeedSettings(depths=(5.0, 20.0), height=2.5, spread=0.0, speeds=(0.5, 1.2))
    seed = drifting_seed(record, settings, 400, np.random.default_rng(0))
    assert ((seed.positions[:, 2] >= -2.0) & (seed.positions[:, 2] <= 0.5)).all()
    assert seed.peaks.min() >= 0.25 and seed.peaks.max() <= 3.75 and np.ptp(seed.peaks) > 3.0
    ahead = seed.positions[:, 0] - 8.0 * seed.peaks  # the camera is up to a quarter of a second off
    assert ahead.min() > 5.0 - 2.1 and ahead.max() < 20.0 + 2.1
    assert (np.abs(seed.positions[:, 1]) <= ahead + 2.1).all()
    assert ((seed.velocities[:, 0] > 3.9) & (seed.velocities[:, 0] < 9.7)).all() and not seed.velocities[:, 1:].any()


def test_seeds_of_a_standing_camera_move_at_random():
    seed = drifting_seed(driven(speed=0.0), DriftingSeedSettings(spread=3.0), 2000, np.random.default_rng(0))
    np.testing.assert_allclose(seed.velocities[:, :2].std(axis=0), 3.0, rtol=0.1)
    assert not seed.velocities[:, 2].any()


def test_the_ego_velocity_is_known_at_images_of_several_cameras_at_one_time():
    record = driven()
    record.timestamps[4] = record.timestamps[5]
    record.ego_to_world[4] = record.ego_to_world[5]
    velocities = ego_velocities(record, np.arange(9))
    np.testing.assert_allclose(velocities, np.tile([8.0, 0.0, 0.0], (9, 1)), atol=1e-9)
    assert not ego_velocities(record, np.array([3])).any()


# ---- in a model


def an_untrained_model(settings: TrainSettings, **more: object) -> SplatModel:
    init = ModelInit(driven(), [], np.full(3, 0.5), **more)
    return build_model(init, ("background", "drifting"), "none", settings)


def test_the_number_of_drifting_gaussians_is_a_share_of_all_others():
    own = DriftingSettings(fraction=0.2, seed=DriftingSeedSettings(fraction=0.5))
    model = an_untrained_model(TrainSettings(cap_max=1000, drifting=own))
    assert [part.name for part in model.parts] == ["background", "drifting"]
    assert len(model.parts[1]) == 100 and model.parts[1].cap_max == 200
    assert model.moving().sum() == 100 and model.of_track("drifting") is None
    no_images = dataclasses.replace(driven(), splits={"train": np.array([], dtype=np.int64)})
    init = ModelInit(no_images, [], np.full(3, 0.5))
    without = build_model(init, ("background", "drifting"), "none", TrainSettings())
    assert [part.name for part in without.parts] == ["background"]


def test_drifting_gaussians_are_no_objects_whose_alpha_has_a_loss():
    model = an_untrained_model(TrainSettings(cap_max=100))
    view = looking_at([10.0, 0.0, -1.0], [0.0, 0.0, 0.0], 1.0)
    with torch.no_grad():
        picture = model.render(view)
        assert model.objects_alpha(picture, view) is None


def test_densification_copies_motion_and_life_with_each_gaussian(monkeypatch):
    """Where Gaussians are relocated and added, the rows of all parameters remain those of one of the Gaussians before;
    only opacities and scales change."""
    monkeypatch.setattr(strategies, "GROWTH", 0.5)
    mcmc = McmcSettings(refine_every=1, noise_lr=0.0)
    settings = TrainSettings(iterations=10, refine_start=0.0, refine_stop=1.0, mcmc=mcmc)
    part = drifting(count=40)
    part.params["opacities"].data[:10] = -20.0
    part.cap_max = 50
    names = [name for name in part.params if name not in ("opacities", "scales")]

    def rows() -> set[bytes]:
        joined = torch.cat([part.params[name].detach().reshape(part.row_count, -1) for name in names], dim=1)
        return {row.numpy().tobytes() for row in joined}

    before = rows()
    (optimizers,) = make_optimizers(SplatModel([part], None)).parts
    assert {"velocities", "peaks", "spans"} <= optimizers.keys()
    Densifier(part, Schedule.of(settings, 1)).after_step(1, optimizers, {}, slice(0, 40))
    assert len(part) == 50 and {len(value) for value in part.params.values()} == {50}
    assert rows() <= before and len(rows()) <= 30


def test_exports_show_the_gaussians_that_are_present_as_one_group():
    """A broken one is there, too, for the export to drop it with a warning."""
    part = drifting()
    part.params["peaks"].data[:3], part.params["peaks"].data[3:] = 100.0, 3.0
    part.params["peaks"].data[2] = torch.nan
    (name, group), *others = part.rigid_groups(3.0).items()
    assert (name, group.motion, len(group.gaussians), others) == ("drifting", None, COUNT - 2, [])
    torch.testing.assert_close(group.gaussians.means[1:], sampled(part, 3.0).means[3:])
    assert not group.gaussians.means[0].isfinite().any()


# ---- a fit


def looking_on(times: np.ndarray) -> list[View]:
    """Views of a camera that stands."""
    return [looking_at([0.0, 0.0, 0.0], [0.0, -6.0, 1.0], float(time)) for time in times]


def recorded(views: list[View]) -> list[TrainingView]:
    """Images of a red ball that rolls along x at 1.2 m/s, on black."""
    found = []
    for view in views:
        place, color = torch.tensor([[1.2 * view.time - 1.8, 0.0, 0.0]]), torch.tensor([[0.9, 0.2, 0.1]])
        image = rasterize(
            place, torch.eye(4)[:1], torch.full((1, 3), 0.3), torch.tensor([0.95]), color, view.viewmat[None],
            view.K[None], view.width, view.height,
        ).image[0]  # fmt: skip
        found.append(TrainingView(view, (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)))
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("one_thread")
def test_what_moves_is_learned_with_its_velocity_and_shown_between_the_images():
    """From Gaussians that stand along its way; static ones cannot show it between the images."""
    rng = np.random.default_rng(0)
    places = np.stack([rng.uniform(-2.0, 2.0, 40), rng.normal(size=40) * 0.1, rng.normal(size=40) * 0.2], axis=1)
    colors, errors = np.full((40, 3), 0.5), {}
    gaussians = GaussianSettings(sh_degree=0, lr_means=2e-3, lr_sh0=2e-2)
    seed = DriftingSeed(places, np.zeros((40, 3)), (places[:, 0] + 1.8) / 1.2, colors, np.full(40, 0.2))
    parts = {
        "drifting": Drifting.from_seed(seed, DriftingSettings(lr_velocities=0.05), gaussians, 4.0, (0.0, 3.0)),
        "static": Background.from_points(places, colors, gaussians, 4.0),
    }
    train, between = np.linspace(0.0, 3.0, 13), np.linspace(0.125, 2.875, 12)
    for name, part in parts.items():
        model = SplatModel([part], None)
        settings = TrainSettings(iterations=200, opacity_reg=0, scale_reg=0, entropy_weight=0, sh_every=0)
        trainer = Trainer.begin(model, recorded(looking_on(train)), settings, 0, torch.device("cpu"))
        for _ in range(200):
            trainer.training_step()
            trainer.state.step += 1
        with torch.no_grad():
            shown = [
                (model.render(it.view).image - it.pixels / 255.0).square().mean()
                for it in recorded(looking_on(between))
            ]
        errors[name] = float(torch.stack(shown).mean())
    seen = sampled(parts["drifting"], 1.5).opacities.detach()
    velocity = (seen[:, None] * sampled(parts["drifting"], 1.5, SCAN).velocities).sum(dim=0) / seen.sum()
    assert errors["drifting"] < 0.2 * errors["static"]
    assert float(velocity[0]) == pytest.approx(1.2, abs=0.3)
