"""What an iteration changes at random: which Gaussians it leaves out, and which objects it mirrors."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made import motion_through, track_of
from helpers.records import training_record_of
from helpers.trainings import inputs_in, job_of, recorded_views, settings_of, untrained_street

from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import want_of
from drivesplat.model.timeline import ActorTrack
from drivesplat.model.view import RollingShutter, View
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.train_objects import DeformableSettings
from drivesplat.training.augmentation import (
    choose_mirrored,
    dropout_share,
    mirrored_at_random,
    mirrored_shares,
    with_dropout,
)
from drivesplat.training.loop import Trainer
from drivesplat.training.stage import prepare


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_random_share_of_the_static_gaussians_is_left_out(share):
    """And gets no gradient."""
    torch.manual_seed(0)
    model = untrained_street(settings_of())
    sets, moving = model.sample(model.states(0.5)), model.moving()
    gaussians = concatenate(sets)
    shown = [concatenate(with_dropout(sets, model, share)) for _ in range(200)]
    left_out = torch.stack([some.opacities != gaussians.opacities for some in shown])
    assert not left_out[:, moving].any()
    often = left_out[:, ~moving].float().mean(dim=0)
    assert float(often.mean()) == pytest.approx(share, abs=0.02) and float((often - share).abs().max()) < 0.15
    once, hidden, still = shown[0].opacities, left_out[0], model.parts[0].params["opacities"]
    assert hidden.any() and not once[hidden].any()
    once.sum().backward()
    assert not still.grad[hidden[model.rows[0]]].any() and still.grad[~hidden[model.rows[0]]].all()


@pytest.mark.parametrize(
    ("images", "cameras", "expected"),
    [(0, 1, 0.0), (7, 1, 0.2), (20, 1, 0.2), (40, 1, 0.1), (40, 2, 0.2), (120, 2, 0.2 / 3)],
)
def test_dropout_shrinks_with_the_training_images_of_a_camera(images, cameras, expected):
    """Held-out images, eight more, do not count."""
    names = [f"CAM_{i}" for i in range(cameras)]
    indices = np.arange(images + 8) % cameras
    splits = {"train": np.arange(images), "interpolation": np.arange(images, images + 8)}
    record = training_record_of(images + 8, camera_names=names, camera_indices=indices, splits=splits)
    assert dropout_share(record, settings_of(dropout=0.2)) == pytest.approx(expected)
    assert dropout_share(record, settings_of(dropout=0.0)) == 0.0


def test_a_training_takes_the_share_of_its_scene(tmp_path):
    inputs = inputs_in(tmp_path)
    share = prepare(inputs, job_of(dropout=0.3, dropout_images=1), torch.device("cpu")).settings.dropout
    assert len(inputs.record.train_images) > 1
    assert share == pytest.approx(0.3 / len(inputs.record.train_images))


def street(mirrored: float) -> SplatModel:
    """Background, and two objects that deform, mirrored with this probability."""
    model = untrained_street(settings_of(), people=True)
    model.parts[1].mirrored = torch.full((2,), mirrored) if mirrored else None
    return model


def one_view(rolling: bool = False) -> View:
    view = recorded_views()[1].view
    shutter = RollingShutter(torch.tensor([0.0, 0.03, 0.0]), torch.zeros(3, 4))
    return dataclasses.replace(view, shutter=shutter) if rolling else view


def shown_in(model: SplatModel, view: View) -> list[Gaussians]:
    """The set of each part that a step renders in a view."""
    want = want_of(model.seen_from(view))
    return model.sample(mirrored_at_random(model, model.states(view.time, want)), want)


def are_equal(found: Gaussians, expected: Gaussians) -> bool:
    return all(torch.equal(found.tensors[name], values) for name, values in expected.tensors.items())


def test_objects_are_mirrored_at_random():
    """Each for itself, in its share of the iterations; nothing else changes."""
    torch.manual_seed(0)
    share = 0.3
    model, view = street(share), one_view()
    recorded = model.sample(model.states(view.time))
    shown = [shown_in(model, view) for _ in range(200)]
    assert all(are_equal(static, recorded[0]) for static, _ in shown)
    moved = torch.stack([(objects.means - recorded[1].means).norm(dim=1) > 1e-4 for _, objects in shown])
    tracks = [model.parts[1].of_track(track.id) for track in model.parts[1].timeline.tracks]
    often = torch.stack([moved[:, own].any(dim=1) for own in tracks]).double()
    np.testing.assert_allclose(often.mean(dim=1), share, atol=0.08)
    np.testing.assert_allclose((often[0] * often[1]).mean(), share**2, atol=0.08)


def test_without_mirroring_the_gaussians_are_those_of_the_time_and_no_random_number_is_drawn():
    model, view = street(0.0), one_view()
    torch.manual_seed(3)
    first = torch.rand(())
    torch.manual_seed(3)
    for found, expected in zip(shown_in(model, view), model.sample(model.states(view.time)), strict=True):
        assert are_equal(found, expected)
    assert torch.rand(()) == first


@pytest.mark.parametrize("mirrored", [0.0, 1.0])
def test_a_rolling_shutter_has_the_velocities_of_what_is_shown(mirrored):
    model, view, step = street(mirrored), one_view(rolling=True), 1e-2
    static, objects = shown_in(model, view)
    earlier, later = (
        shown_in(model, dataclasses.replace(view, time=view.time + after))[1].means.detach() for after in (-step, step)
    )
    assert static.velocities is None or not static.velocities.any()
    torch.testing.assert_close(objects.velocities, (later - earlier) / (2.0 * step), atol=0.05, rtol=0.02)
    assert objects.velocities.norm(dim=1).max() > 0.1


def test_an_iteration_leaves_out_static_gaussians_and_mirrors_objects():
    model, views = street(1.0), recorded_views()
    trainer = Trainer.begin(model, views, settings_of(dropout=0.5), 0, torch.device("cpu"))
    _, picture, view = trainer.training_step()
    still = street(0.0)
    recorded = still.sample(still.states(view.view.time))[1]
    static, objects = picture.sets
    assert 0.2 < float((static.opacities == 0.0).float().mean()) < 0.8
    assert not (objects.opacities == 0.0).all()
    assert ((objects.means - recorded.means).norm(dim=1) > 1e-4).any()


def images_of(count: int, cameras: int = 1, hz: float = 2.0) -> TrainingRecord:
    """A record of so many training images of each camera, `hz` a second."""
    names = [f"CAM_{i}" for i in range(cameras)]
    frames = np.repeat(np.arange(count), cameras)
    splits = {"train": np.arange(count * cameras)}
    return training_record_of(
        count * cameras, camera_names=names, camera_indices=np.arange(count * cameras) % cameras, splits=splits,
        timestamps=(1e6 / hz * frames).astype(np.int64),
    )  # fmt: skip


def seen_for(seconds: float) -> ActorTrack:
    """A track with annotations twice a second, the last after so many seconds."""
    times = np.arange(0.0, seconds + 0.25, 0.5)
    return track_of(motion_through(times, np.zeros((len(times), 3)), np.zeros(len(times))), f"{seconds} s")


@pytest.mark.parametrize(
    ("images", "cameras", "expected"), [(5, 1, 0.6), (30, 3, 0.6), (45, 1, 0.3), (45, 3, 0.3), (60, 1, 0.0)]
)
def test_objects_in_many_images_of_a_camera_are_mirrored_less(images, cameras, expected):
    found = mirrored_shares([seen_for(100.0)], images_of(images, cameras), DeformableSettings(mirrored=0.6))
    np.testing.assert_allclose(found, [expected], atol=0.02)


def test_the_images_count_in_which_an_object_is_present():
    """Of two hundred images of a camera, one shows the first object in twenty, the other in all."""
    model, record, tracks = street(0.0), images_of(200), (seen_for(9.5), seen_for(100.0))
    half = DeformableSettings(mirrored=0.4, mirrored_images=15)
    assert 0.0 < mirrored_shares(tracks, record, half)[0] < 0.4
    model.parts[1].timeline.tracks = tracks

    def chosen(share: float, record: TrainingRecord, of: SplatModel = model) -> torch.Tensor | None:
        choose_mirrored(of, record, settings_of(deformable=DeformableSettings(mirrored=share)))
        return of.parts[1].mirrored

    np.testing.assert_allclose(chosen(0.4, record), [0.4, 0.0], atol=1e-6)
    assert chosen(0.0, record) is None
    assert (chosen(0.4, images_of(0)) == 0.4).all(), "without images, as a LiDAR alone"
    assert chosen(0.4, record, untrained_street(settings_of())) is None, "vehicles"
