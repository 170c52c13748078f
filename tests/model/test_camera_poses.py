"""Learned corrections of camera poses: bounded, smooth, and interpolated where no training image is."""

import json
import math

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z, round_gaussians
from helpers.trainings import PROVENANCE, parser_record, recorded_views, settings_of
from scipy.spatial.transform import Rotation

from drivesplat.model.build import definitions, rebuild_model
from drivesplat.model.camera_poses import CameraPoses, transform
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.scene.rigid import rigid
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import TrainJob, TrainSettings
from drivesplat.settings.train_cameras import CameraPoseSettings
from drivesplat.training.losses import loss_terms
from drivesplat.training.optimizers import make_optimizers, set_learning_rates
from drivesplat.training.resume_state import restore_model
from drivesplat.training.run import TrainingFiles, TrainingInputs, run_training
from drivesplat.training.trainer import Trainer
from drivesplat.training.views import TrainingView

pytestmark = pytest.mark.usefixtures("one_thread")

TIMES = [0.0, 0.5, 1.0, 2.0, 2.5]
"""Seconds of training images; 1.5 is held out."""
SIZE = (64, 48)
LOOSE = {"max_shift": 0.2, "max_turn": 3.0, "learning_rate": 0.02, "size_weight": 1e-5, "bend_weight": 1e-4}


def a_view(time: float, camera: str | None = "FRONT", moved: np.ndarray | None = None) -> View:
    """Looks along x from where a car is that drives along y, from a pose in error by `moved` (4, 4)."""
    looks = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    pose = rigid(about_z(0.1 * time) @ looks, np.array([0.0, 0.4 * time, 0.0])) @ (
        np.eye(4) if moved is None else moved
    )
    k = torch.tensor([[50.0, 0.0, SIZE[0] / 2], [0.0, 50.0, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    return View(k, torch.from_numpy(pose).float(), *SIZE, time, camera)


def poses(settings: dict | None = None, camera: str = "FRONT") -> CameraPoses:
    return CameraPoses({camera: TIMES}, CameraPoseSettings(corrected=True, **(settings or {})))


def correction(of: CameraPoses, time: float, camera: str | None = "FRONT") -> np.ndarray:
    """(4, 4), in the camera's frame."""
    view = a_view(time, camera)
    moved = of.corrected(view).camera_to_world.detach().double().numpy()
    return np.linalg.inv(view.camera_to_world.double().numpy()) @ moved


def filled(of: CameraPoses, seed: int = 0, spread: float = 1.0) -> CameraPoses:
    with torch.no_grad():
        for numbers in of.params.values():
            numbers.copy_(spread * torch.randn(numbers.shape, generator=torch.Generator().manual_seed(seed)))
    return of


def test_a_small_correction_is_the_rigid_transform_of_its_rotation_vector():
    vector = np.array([0.01, -0.02, 0.005, 0.004, -0.003, 0.005])
    expected = rigid(Rotation.from_rotvec(vector[3:]).as_matrix(), vector[:3])
    np.testing.assert_allclose(transform(torch.from_numpy(vector)).numpy(), expected, atol=1e-7)
    numbers = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    transform(numbers)[:3, 3].sum().backward()
    assert torch.isfinite(numbers.grad).all(), "there is a gradient at no correction"


def test_initial_poses_and_other_cameras_are_not_corrected():
    fresh, learned = poses(), filled(poses())
    view = a_view(0.7)
    torch.testing.assert_close(fresh.corrected(view).camera_to_world, view.camera_to_world)
    for camera in ("BACK", None):
        other = a_view(0.7, camera)
        assert learned.corrected(other) is other
    assert not np.allclose(correction(learned, 0.7), np.eye(4), atol=1e-3)


@pytest.mark.parametrize("spread", [1.0, 100.0])
def test_corrections_are_bounded(spread):
    learned = filled(poses({"max_shift": 0.03, "max_turn": 0.2}), spread=spread)
    for time in TIMES:
        moved = correction(learned, time)
        turn = np.degrees(Rotation.from_matrix(moved[:3, :3]).as_rotvec())
        assert np.abs(moved[:3, 3]).max() <= 0.03 + 1e-6 and np.abs(turn).max() <= 0.2 + 1e-3
    assert np.abs(moved[:3, 3]).max() > 0.005


def test_corrections_are_interpolated_between_training_images_and_constant_beyond():
    learned = filled(poses(), spread=0.2)
    numbers = learned.params["FRONT"].detach()
    for time, expected in [(0.125, 0.75 * numbers[0] + 0.25 * numbers[1]), (1.5, 0.5 * (numbers[2] + numbers[3]))]:
        between = transform(learned.bounds * torch.tanh(expected)).double().numpy()
        np.testing.assert_allclose(correction(learned, time), between, atol=1e-6)
    np.testing.assert_allclose(correction(learned, -3.0), correction(learned, 0.0), atol=1e-6)
    np.testing.assert_allclose(correction(learned, 9.0), correction(learned, 2.5), atol=1e-6)


def test_penalties_are_of_size_and_second_differences():
    learned = filled(poses({"size_weight": 0.3, "bend_weight": 0.7}))
    parts = np.tanh(learned.params["FRONT"].detach().double().numpy())
    bends = parts[:-2] - 2 * parts[1:-1] + parts[2:]
    expected = 0.3 * (parts**2).sum(axis=1).mean() + 0.7 * (bends**2).sum(axis=1).mean()
    assert float(learned.penalty("FRONT").detach()) == pytest.approx(expected, rel=1e-5)
    assert learned.penalty("BACK") is None and learned.penalty(None) is None
    few = CameraPoses({"FRONT": [0.0, 1.0]}, CameraPoseSettings(corrected=True))
    assert float(few.penalty("FRONT").detach()) == 0.0


# ---- in a training


def wrong_by(time: float) -> np.ndarray:
    """A slow error of poses: centimetres and a degree."""
    return rigid(
        Rotation.from_rotvec([0.012 * math.sin(time), 0.01, 0.008 * time]).as_matrix(),
        np.array([0.04 * math.cos(time), 0.02 * time, 0.0]),
    )


def street() -> list:
    random = np.random.default_rng(3)
    places = np.stack([random.uniform(2, 6, 120), random.uniform(-2.5, 3, 120), random.uniform(-1.5, 1.5, 120)], axis=1)
    return [places, random.uniform(0.05, 0.15, 120), 0.9, random.uniform(0, 1, (120, 3))]


def model_of(camera_poses: CameraPoses | None) -> SplatModel:
    return SplatModel([round_gaussians(*street())], None, camera_poses=camera_poses)


def fitted(camera_poses: CameraPoses | None, iterations: int = 300) -> SplatModel:
    """A model whose Gaussians are right and stay, trained on images with wrong poses."""
    truth = model_of(None)
    views = []
    for time in TIMES:
        with torch.no_grad():
            image = truth.render(a_view(time)).image
        views.append(TrainingView(a_view(time, moved=wrong_by(time)), (image * 255).round().to(torch.uint8)))
    settings = TrainSettings(iterations=iterations, opacity_reg=0, scale_reg=0)
    model = model_of(camera_poses)
    for parameter in model.parts[0].params.values():
        parameter.requires_grad_(False)
    trainer = Trainer.begin(model, views, settings, 0, torch.device("cpu"))
    for _ in range(iterations if camera_poses is not None else 0):
        trainer.fit_one()
        trainer.step += 1
    return model


def test_a_resumed_training_keeps_its_corrections():
    had, again = fitted(poses(LOOSE), iterations=5), model_of(poses(LOOSE))
    assert any(value.any() for value in had.camera_poses.params.values())
    restore_model(again, {name: value.clone() for name, value in had.state_dict().items()})
    assert again.state_dict().keys() == had.state_dict().keys()
    assert all(torch.equal(value, had.state_dict()[name]) for name, value in again.state_dict().items())


def off(model: SplatModel, time: float) -> tuple[float, float]:
    """How far (metres) and how much (degrees) the camera is from where it really was, at a time."""
    seen_from = model.seen_from(a_view(time, moved=wrong_by(time))).camera_to_world.detach().double().numpy()
    left = np.linalg.inv(a_view(time).camera_to_world.double().numpy()) @ seen_from
    return float(np.linalg.norm(left[:3, 3])), float(np.degrees(Rotation.from_matrix(left[:3, :3]).magnitude()))


@pytest.fixture(scope="module")
def learned() -> SplatModel:
    return fitted(poses(LOOSE))


@pytest.mark.slow
@pytest.mark.parametrize("time", [*TIMES, 1.5])
def test_wrong_poses_are_corrected_at_training_and_held_out_images(learned, time):
    shift, turn = off(learned, time)
    given_shift, given_turn = off(fitted(None), time)
    assert shift < 0.6 * given_shift and turn < 0.35 * given_turn


@pytest.mark.slow
def test_a_held_out_image_uses_the_corrections_of_its_neighbours(learned):
    with torch.no_grad():
        truth = model_of(None).render(a_view(1.5)).image
        view = a_view(1.5, moved=wrong_by(1.5))
        errors = [float((model.render(view).image - truth).square().mean()) for model in (learned, fitted(None))]
    assert errors[0] < 0.1 * errors[1]


def test_objects_and_classes_are_rendered_from_the_corrected_pose(learned):
    """What is composited apart lies over the image: its alpha is the image's where all is composited."""
    view = a_view(1.0, moved=wrong_by(1.0))
    with torch.no_grad():
        picture = learned.render(view)
        alone = learned.composited(picture.shapes, torch.ones_like(picture.shapes.means), view)
    torch.testing.assert_close(alone.alpha[0, ..., 0], picture.alpha)


def test_the_penalty_is_a_loss_term_only_for_corrected_cameras(learned):
    view = TrainingView(a_view(1.0), torch.zeros(SIZE[1], SIZE[0], 3, dtype=torch.uint8))
    for model, pays in ((learned, True), (model_of(None), False)):
        terms = loss_terms(model.render(view.view), view, model, TrainSettings())
        assert ("camera_poses" in terms) == pays


def test_a_checkpoint_holds_corrections_and_their_times(learned):
    settings = TrainSettings(camera_poses=CameraPoseSettings(corrected=True, **LOOSE))
    for model in (learned, model_of(None)):
        rebuilt = rebuild_model(model.state_dict(), definitions(model), "none", settings)
        view = a_view(1.5)
        torch.testing.assert_close(rebuilt.seen_from(view).camera_to_world, model.seen_from(view).camera_to_world)


def test_the_learning_rate_of_corrections_decays_and_they_are_logged(learned):
    optimizers = make_optimizers(learned)
    set_learning_rates(learned, optimizers, 0.5, TrainSettings())
    group = optimizers.beside_parts["camera_poses"]["FRONT"].param_groups[0]
    assert group["lr"] == pytest.approx(0.1 * LOOSE["learning_rate"])
    figures = learned.camera_poses.figures()
    assert 0.01 < figures["FRONT/shift_m"] < 0.2 and 0.3 < figures["FRONT/turn_deg"] < 3.0


# ---- in a training


@pytest.mark.parametrize("corrected", [True, False])
def test_a_training_corrects_its_cameras_where_the_settings_say_so(tmp_path, corrected):
    """Of six images half a second apart the third is held out; train.json says how far poses were corrected."""
    poses = CameraPoseSettings(corrected=corrected, learning_rate=0.05)
    train = settings_of(iterations=20, checkpoint_every=50, pixels_per_gaussian=0, camera_poses=poses)
    job = TrainJob(parts=("background",), sky="none", train=train, random_seed=0)
    inputs = TrainingInputs(parser_record(tmp_path, recorded_views(6)), tmp_path, [], [])
    files = TrainingFiles(tmp_path / "it/checkpoint.npz", tmp_path / "it/train.json")
    run_training(inputs, job, DeviceSettings(kind="cpu"), files, PROVENANCE, "train")
    model = trained_model(read_checkpoint(files.checkpoint))
    saved = json.loads(files.summary.read_text())["of_cameras"]
    if not corrected:
        assert model.camera_poses is None and saved == {}
        return
    figures = {f"camera_poses/{name}": value for name, value in model.camera_poses.figures().items()}
    assert saved == pytest.approx(figures) and saved["camera_poses/CAM_FRONT/shift_m"] > 1e-4
    assert len(model.camera_poses.params["CAM_FRONT"]) == 5, "one correction for every training image"
