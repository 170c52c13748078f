"""Cameras that expose each in their own way: what is learned of it, what it is worth, and what keeps it."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.rig_drives import RIG, recorder_of, rig_drive
from helpers.trainings import (
    CHECKPOINT_AT,
    CPU,
    ITERATIONS,
    PROVENANCE,
    EndedError,
    EndingViews,
    mean_psnr,
    parser_record,
    recorded_views,
    same_parameters,
    settings_of,
    trained,
    untrained,
)
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from drivesplat.model.build import definitions, rebuild_model
from drivesplat.model.checkpoint import read_checkpoint, trained_model
from drivesplat.model.exposure import Exposures, GainCurve, exposure_nodes
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.preprocess.lidar_seed import seed_points
from drivesplat.preprocess.parser import training_record
from drivesplat.settings.config import load
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.images import HoldoutSettings, ImageSettings, ParserJob
from drivesplat.settings.lidar_seed import LidarSeedSettings, SeedJob
from drivesplat.settings.train import ExposureSettings, TrainJob, TrainSettings
from drivesplat.training.exposure_init import (
    DISTANCE_STEP,
    DRIFT,
    Sightings,
    gain_curve_of,
    gains_over_time,
    initial_gains,
    log_colors,
    log_gains,
    without_drift,
)
from drivesplat.training.losses import loss_terms
from drivesplat.training.optimizers import make_optimizers, set_learning_rates
from drivesplat.training.schedule import Schedule
from drivesplat.training.stage import TrainingFiles, TrainingInputs, run_training
from drivesplat.training.views import Supervision, TrainingView, load_views
from drivesplat.workflow.stages import stage_settings

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

AFFINE = ExposureSettings(kind="affine", sigma_gain=0.2, sigma_offset=0.05, learning_rate=0.1)
GAINS = torch.tensor([1.25, 1.1, 0.8])
OFFSET = 0.03


def rig_views(count: int = 6) -> list[TrainingView]:
    """What two cameras record by turns of the same cloud: FRONT as it is, BACK with other gains and an offset."""
    views = []
    for i, seen in enumerate(recorded_views(count)):
        light = 0.7 * seen.target()
        camera, image = ("BACK", light * GAINS + OFFSET) if i % 2 else ("FRONT", light)
        pixels = image.mul(255.0).round().to(torch.uint8)
        views.append(TrainingView(dataclasses.replace(seen.view, camera=camera), pixels))
    return views


def exposed(settings: TrainSettings) -> SplatModel:
    """An untrained model that learns how BACK exposes."""
    model = untrained(settings)
    return SplatModel(list(model.parts), None, exposure=exposures_of("BACK", settings=settings.exposure))


def exposures_of(*cameras: str, settings: ExposureSettings) -> Exposures:
    """Of cameras that are found to be as the reference."""
    return Exposures({camera: torch.ones(3) for camera in cameras}, settings)


def of(camera: str, views: list[TrainingView]) -> list[TrainingView]:
    return [view for view in views if view.view.camera == camera]


def test_exposure_applies_to_listed_cameras_and_not_to_the_reference():
    exposures = exposures_of("BACK", settings=AFFINE)
    image, view = torch.rand(4, 5, 3), rig_views()[0].view

    def applied(exposures: Exposures, camera: str | None) -> torch.Tensor:
        return exposures.applied(image, dataclasses.replace(view, camera=camera))

    torch.testing.assert_close(applied(exposures, "BACK"), image)
    with torch.no_grad():
        exposures.params["BACK"][0], exposures.params["BACK"][1] = GAINS.log() / 0.2, OFFSET / 0.05
    torch.testing.assert_close(applied(exposures, "BACK"), image * GAINS + OFFSET)
    for camera in ("FRONT", None):
        assert applied(exposures, camera) is image
    figures = exposures.figures()
    assert figures["BACK/gain_blue"] == pytest.approx(0.8) and figures["BACK/offset_red"] == pytest.approx(OFFSET)
    assert len(figures) == 6
    found = Exposures({"BACK": GAINS}, AFFINE)
    torch.testing.assert_close(applied(found, "BACK"), image * GAINS)
    assert not found.penalty("BACK").any(), "what was found is free"


def test_gains_over_time_are_linear_between_nodes_and_constant_beyond():
    nodes = exposure_nodes([3.0, 1.0, 5.0], 2.0)
    assert nodes.tolist() == [1.0, 3.0, 5.0]
    exposures = Exposures({"BACK": GAINS}, AFFINE, ("FRONT",), nodes)
    assert exposures.params["FRONT"].shape == (3, 3) and exposures.params["BACK"].shape == (5, 3)
    with torch.no_grad():
        exposures.params["FRONT"][:, 0] = torch.tensor([2.0, 4.0, 1.0]).log() / AFFINE.sigma_gain
    image, view = torch.full((1, 1, 3), 0.1), rig_views()[0].view
    for seconds, gain in ((0.0, 2.0), (1.0, 2.0), (2.0, 8.0**0.5), (3.0, 4.0), (4.0, 2.0), (9.0, 1.0)):
        for known in (None, torch.tensor(seconds)):
            seen = dataclasses.replace(view, camera="FRONT", time=seconds, seconds=known)
            torch.testing.assert_close(exposures.applied(image, seen), image * torch.tensor([gain, 1.0, 1.0]))
    figures = exposures.figures()
    assert figures["FRONT/factor_largest"] == pytest.approx(4.0) and figures["FRONT/factor_least"] == 1.0
    copied = Exposures({"BACK": GAINS}, AFFINE, ("FRONT", "BACK"), nodes)
    copied.load_state_dict(exposures.state_dict())


def test_what_is_learned_over_time_is_added_to_the_gain_curve_that_is_known():
    nodes = torch.tensor([0.0, 1.0, 2.0])
    curve = {"FRONT": torch.tensor([[0.0], [1.0], [0.5]]).expand(3, 3)}
    exposures = Exposures({}, AFFINE, ("FRONT",), nodes, curve)
    with torch.no_grad():
        exposures.params["FRONT"][1] = 1.0
    image, view = torch.full((1, 1, 3), 0.1), dataclasses.replace(rig_views()[0].view, camera="FRONT")
    for seconds, log_gain in ((0.0, 0.0), (1.0, 1.2), (1.5, 0.85), (9.0, 0.5)):
        seen = exposures.applied(image, dataclasses.replace(view, time=seconds))
        torch.testing.assert_close(seen, image * math.exp(log_gain))
    assert exposures.figures()["FRONT/factor_largest"] == pytest.approx(math.exp(1.2))
    assert exposures.penalty("FRONT").item() > 0 and not exposures.curve["FRONT"].requires_grad
    free = dataclasses.replace(view, camera=None, time=1.5)
    torch.testing.assert_close(exposures.applied(image, free), image * math.exp(0.75), msg="its curve alone")
    other = dataclasses.replace(view, camera="BACK", time=1.5)
    assert exposures.applied(image, other) is image


def test_a_gain_curve_is_linear_between_images_and_constant_beyond():
    curve = GainCurve(np.array([1.0, 1.5, 3.0]), np.array([[0.0, 0.3, 1.0], [0.2, 0.3, 0.0], [0.5, 0.0, 0.0]]))
    assert curve.interval == 1.0
    np.testing.assert_allclose(curve.at(np.array([0.0, 1.25, 2.0, 9.0]))[:, 0], [0.0, 0.1, 0.3, 0.5])


@pytest.mark.parametrize(("seconds", "interval"), [([1.0, 3.0], None), ([], 1.0), ([1.0], 1.0), ([1.0, 1.4], 1.0)])
def test_exposures_of_short_drives_are_constant(seconds, interval):
    assert len(exposure_nodes(seconds, interval)) == 0


def test_changes_of_gains_cost_more_than_gains():
    nodes = torch.tensor([0.0, 0.5, 1.0])
    exposures = Exposures({}, ExposureSettings(weight=1.0), ("FRONT",), nodes)
    with torch.no_grad():
        exposures.params["FRONT"][:] = 0.3
    assert exposures.penalty("FRONT").item() == pytest.approx(0.09)
    with torch.no_grad():
        exposures.params["FRONT"][1] = 0.0
    assert exposures.penalty("FRONT").item() == pytest.approx(0.06 + (2.0 * 0.3) ** 2 / 0.5)


def test_the_penalty_is_the_weighted_mean_square_of_the_rendered_camera():
    exposures = exposures_of("BACK", "LEFT", settings=ExposureSettings(weight=0.4))
    with torch.no_grad():
        exposures.params["BACK"][0] = 0.3
    assert float(exposures.penalty("BACK").detach()) == pytest.approx(0.4 * 0.5 * 0.09)
    assert float(exposures.penalty("LEFT").detach()) == 0.0
    assert exposures.penalty("FRONT") is None and exposures.penalty(None) is None
    assert exposures_of("BACK", settings=ExposureSettings(weight=0.0)).penalty("BACK") is None


def test_exposure_applies_to_the_image_with_sky_and_not_to_the_splats():
    settings = settings_of(exposure=AFFINE)
    model = exposed(settings)
    model.sky = untrained(settings, sky=True).sky
    with torch.no_grad():
        model.exposure.params["BACK"][0] = math.log(2.0) / 0.2
    front, back = (model.render(dataclasses.replace(rig_views()[0].view, camera=c)) for c in ("FRONT", "BACK"))
    torch.testing.assert_close(back.image, 2.0 * front.image)
    torch.testing.assert_close(back.splats, front.splats)
    assert not torch.equal(front.image, front.splats)


def test_only_the_rendered_camera_has_a_penalty_and_learns():
    views, settings = rig_views(), settings_of(exposure=AFFINE)
    for camera, pays in (("FRONT", False), ("BACK", True)):
        model = exposed(settings)
        view = of(camera, views)[0]
        terms = loss_terms(model.render(view.view), view, model, settings)
        assert ("exposure" in terms) == pays
        sum(terms.values()).backward()
        assert (model.exposure.params["BACK"].grad is not None) == pays


@pytest.fixture(scope="module")
def learned(tmp_path_factory) -> dict[str, SplatModel]:
    """The same drive of two cameras, learned with and without exposures."""
    common = {"iterations": 240, "checkpoint_every": 1000, "log_every": 100, "image_every": 1000}
    folder, models = tmp_path_factory.mktemp("learned"), {}
    for kind, exposure in (("none", ExposureSettings()), ("affine", AFFINE)):
        settings = settings_of(**common, exposure=exposure)
        model = exposed(settings) if kind == "affine" else untrained(settings)
        models[kind], _ = trained(folder / kind, settings, rig_views(), model=model)
    return models


def test_gains_of_a_camera_are_recovered_and_improve_both_cameras(learned):
    """What is learned is what leads from the reference's colours to the camera's."""
    figures = learned["affine"].exposure.figures()
    gains = [figures[f"BACK/gain_{channel}"] for channel in ("red", "green", "blue")]
    np.testing.assert_allclose(gains, GAINS, rtol=0.1)
    assert abs(figures["BACK/offset_green"] - OFFSET) < 0.03
    for camera in ("BACK", "FRONT"):
        views = of(camera, rig_views())
        assert mean_psnr(learned["affine"], views) > mean_psnr(learned["none"], views) + 1.5


def test_a_new_trajectory_is_rendered_in_the_reference_colours(learned):
    view = rig_views()[1].view
    plain, front, back = (
        learned["affine"].render(dataclasses.replace(view, camera=camera)).image for camera in (None, "FRONT", "BACK")
    )
    assert torch.equal(plain, front) and not torch.allclose(plain, back, atol=0.01)


def test_a_checkpoint_holds_exposures(learned):
    model = learned["affine"]
    settings = settings_of(exposure=AFFINE)
    rebuilt = rebuild_model(model.state_dict(), definitions(model), "none", settings)
    assert rebuilt.exposure.figures() == model.exposure.figures()
    view = of("BACK", rig_views())[0].view
    torch.testing.assert_close(rebuilt.render(view).image, model.render(view).image)
    plain = rebuild_model(learned["none"].state_dict(), definitions(learned["none"]), "none", settings)
    assert plain.exposure is None


def test_a_resumed_training_of_exposures_is_the_same_training(tmp_path):
    settings = settings_of(exposure=AFFINE)
    whole, summary = trained(tmp_path / "whole", settings, rig_views(), model=exposed(settings))
    with pytest.raises(EndedError):
        trained(tmp_path / "it", settings, EndingViews(rig_views(), CHECKPOINT_AT + 8), model=exposed(settings))
    resumed, again = trained(tmp_path / "it", settings, rig_views(), model=exposed(settings))
    assert again.resumed_at == [CHECKPOINT_AT] and again.iterations == ITERATIONS
    assert same_parameters(resumed, whole)
    assert summary.of_cameras == again.of_cameras and summary.of_cameras["exposure/BACK/gain_red"] != 1.0
    board = EventAccumulator(str(tmp_path / "whole/tensorboard"))
    board.Reload()
    assert set(summary.of_cameras) < set(board.Tags()["scalars"])
    assert board.Scalars("exposure/BACK/gain_red")[-1].value == pytest.approx(
        summary.of_cameras["exposure/BACK/gain_red"]
    )


def test_exposures_start_late_and_their_learning_rate_decays():
    settings = settings_of(iterations=100, exposure=AFFINE)
    model = exposed(settings)
    optimizers = make_optimizers(model)
    rates = []
    for step in (0, 9, 10, 50, 100):
        set_learning_rates(model, optimizers, Schedule.of(settings, 1), step)
        rates.append(optimizers.beside_parts["exposure"]["BACK"].param_groups[0]["lr"])
    assert rates == pytest.approx([0.0, 0.0, 0.1 * 0.01**0.1, 0.01, 0.001])


# ---- what is known before


def test_gains_of_a_rig_are_estimated_from_shared_surfaces():
    """The second camera shares surfaces with the first, the third with the second alone, the fourth with none."""
    rng = np.random.default_rng(0)
    true = np.log([[1.0, 1.0, 1.0], [1.3, 1.1, 0.8], [0.7, 1.2, 1.5], [2.0, 2.0, 2.0]])
    shades = rng.uniform(-2.0, -0.5, (900, 3)) + true[:, None] + rng.normal(0.0, 0.05, (4, 900, 3))
    shades[1, rng.random(900) < 0.2] += 1.5  # in some places something else stands before the surface
    for camera, (first, last) in enumerate(((0, 400), (300, 700), (600, 800), (800, 900))):
        shades[camera, :first], shades[camera, last:] = np.nan, np.nan
    unknown = np.full((4, 3), np.nan)
    unknown[0] = 0.0
    found = log_gains(shades, unknown)
    np.testing.assert_allclose(found[:3], true[:3], atol=0.06)
    assert np.isnan(found[3]).all()
    kept = unknown.copy()
    kept[1] = [0.5, 0.5, 0.5]
    np.testing.assert_array_equal(log_gains(shades, kept)[:2], kept[:2])


def test_colors_are_compared_from_equal_distances():
    """Haze brightens what is far. The first camera sees points from both distances, the second from nearby alone."""
    points, dark = np.arange(200), np.full((200, 3), 50.0)
    near, far = np.full(200, 10.0), np.full(200, 40.0)
    first = Sightings(np.tile(points, 2), np.concatenate([near, far]), np.concatenate([dark, dark + 20.0]))
    second = Sightings(points, 1.01 * near, dark)
    np.testing.assert_allclose(np.diff(log_colors([first, second], DISTANCE_STEP), axis=0), 0.0)
    mixed = log_colors([first, second], math.inf)
    np.testing.assert_allclose(mixed[1] - mixed[0], np.log(50.0 / 60.0))


def test_surfaces_that_one_camera_sees_are_left_out():
    seen = [Sightings(np.array(own), np.full(len(own), 5.0), np.full((len(own), 3), 100.0)) for own in ([3, 7], [7, 9])]
    found = log_colors(seen, DISTANCE_STEP)
    np.testing.assert_allclose(found, np.full((2, 1, 3), np.log(100.0 / 255.0)))


def drive_past(true: np.ndarray, haze: float = 0.0) -> list[Sightings]:
    """What a camera records of 600 points ahead while it drives: each image shows those that are 5 to 60 m away, with
    log gains `true` (k, 3). With `haze` colours grow brighter with the distance. Every tenth colour is another's."""
    rng = np.random.default_rng(3)
    places, shades = np.sort(rng.uniform(0.0, 100.0, 600)), rng.uniform(-2.0, -1.0, (600, 3))
    seen = []
    for at, gains in enumerate(true):
        distance = places - 1.2 * at
        shown = np.flatnonzero((distance > 5) & (distance < 60))
        logs = shades[shown] + gains + haze * np.log(distance[shown])[:, None] + rng.normal(0, 0.02, (len(shown), 3))
        logs[rng.random(len(shown)) < 0.1] += 0.8
        seen.append(Sightings(shown, distance[shown], 255.0 * np.exp(logs)))
    return seen


@pytest.mark.parametrize("haze", [0.0, 0.2])
def test_the_gain_curve_of_an_exposure_is_found_whatever_the_distance_does_to_colors(haze):
    true = np.zeros((30, 3))
    true[12:16] = np.linspace(0.0, -0.8, 4)[:, None] * [1.0, 0.9, 0.8]
    true[16:] = true[15]
    found = gain_curve_of(drive_past(true, haze))
    np.testing.assert_allclose(found - found.mean(axis=0), true - true.mean(axis=0), atol=0.05)


def test_images_without_shared_points_have_no_gain_curve():
    apart = [Sightings(np.arange(90) + 90 * i, np.full(90, 9.0), np.full((90, 3), 50.0 + i)) for i in range(4)]
    assert not gain_curve_of(apart).any() and not gain_curve_of(apart[:1]).any() and gain_curve_of([]).shape == (0, 3)


def test_slow_changes_of_an_exposure_are_left_out():
    """They are those of colours that change with the distance."""
    seconds = 0.5 * np.arange(9)
    slow = np.outer(0.04 * np.arange(9), np.ones(3))
    assert not without_drift(slow, seconds).any()
    fast = slow + np.where(np.arange(9) > 4, -0.6, 0.0)[:, None]
    found = without_drift(fast, seconds)
    np.testing.assert_allclose(found - found[0], np.where(np.arange(9) > 4, -0.56, 0.0)[:, None] * np.ones(3))
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=1e-12)
    between = 1.5 * DRIFT * 0.5
    found = without_drift(np.outer([0.0, between], np.ones(3)), seconds[:2])
    np.testing.assert_allclose(np.diff(found, axis=0), np.full((1, 3), 0.5 * between))


@pytest.fixture(scope="module")
def rig(tmp_path_factory) -> TrainingInputs:
    """A drive by FRONT and BACK of the demo's rig, whose BACK takes in other light; nothing is held out."""
    folder = tmp_path_factory.mktemp("rig")
    scene = rig_drive(folder, ["CAM_FRONT", "CAM_BACK"], exposures={"CAM_BACK": (1.4, 1.1, 0.75)})
    holdout, images = HoldoutSettings(every_nth=0, last_block=0), ImageSettings()
    settings = LidarSeedSettings(max_points=20_000, far_points=2_000)
    seed = seed_points(scene, SeedJob(lidar_seed=settings, holdout=holdout, images=images, random_seed=0))
    return TrainingInputs(training_record(scene, seed, ParserJob(holdout=holdout, images=images)), folder, [], [])


def test_the_gains_of_the_demo_rig_are_estimated_before_the_training(rig):
    """Images are gamma encoded: a gain of light becomes its 2.2th root."""
    views = load_views(rig.record, Supervision({}, {}, {}), CPU)
    found = initial_gains(rig.record, views, ["CAM_BACK"], "CAM_FRONT")
    np.testing.assert_allclose(found["CAM_BACK"], np.power([1.4, 1.1, 0.75], 1 / 2.2), rtol=0.03)
    hidden = [dataclasses.replace(v, ego_mask=torch.ones(v.pixels.shape[:2], dtype=torch.bool)) for v in views]
    np.testing.assert_array_equal(initial_gains(rig.record, hidden, ["CAM_BACK"], "CAM_FRONT")["CAM_BACK"], np.ones(3))


def test_an_automatic_exposure_is_found_where_images_change_and_only_there(rig):
    """The images of FRONT grow darker within a second, as if its exposure did."""
    views = load_views(rig.record, Supervision({}, {}, {}), CPU)
    assert gains_over_time(rig.record, views) == {}
    front = sorted((v for v in views if v.view.camera == "CAM_FRONT"), key=lambda view: view.view.time)
    darker = {id(v): max(0.6, 1.0 - 0.2 * max(0, i - 2)) for i, v in enumerate(front)}
    changed = [
        dataclasses.replace(v, pixels=(v.pixels.float() * darker.get(id(v), 1.0)).round().to(torch.uint8))
        for v in views
    ]
    found = gains_over_time(rig.record, changed)
    assert found.keys() == {"CAM_FRONT"}
    true = np.log([darker[id(v)] for v in front])
    np.testing.assert_allclose(found["CAM_FRONT"].log_gains[:, 1], true - true.mean(), atol=0.08)


def test_a_training_starts_from_the_estimated_gains_and_saves_them(rig, tmp_path):
    train = settings_of(iterations=4, checkpoint_every=10, pixels_per_gaussian=0, exposure=AFFINE)
    job = TrainJob(parts=("background",), sky="none", train=train, random_seed=0, reference_camera="CAM_FRONT")
    files = TrainingFiles(tmp_path / "it/checkpoint.npz", tmp_path / "it/train.json")
    run_training(rig, job, DeviceSettings(kind="cpu"), files, PROVENANCE, "train")
    model = trained_model(read_checkpoint(files.checkpoint))
    saved = json.loads(files.summary.read_text())["of_cameras"]
    figures = {f"exposure/{name}": value for name, value in model.exposure.figures().items()}
    assert saved == pytest.approx(figures) and saved["exposure/CAM_BACK/gain_red"] > 1.1
    assert model.exposure.first["CAM_BACK"][0] == pytest.approx(1.4 ** (1 / 2.2), rel=0.03)
    assert not model.exposure.first["CAM_BACK"].requires_grad


# ---- which cameras


def inputs_of(folder: Path, cameras: list[int]) -> TrainingInputs:
    """Images by FRONT, BACK and LEFT, as `cameras` numbers them; the third is held out."""
    record = parser_record(folder, recorded_views(5))
    rig = {"camera_names": ["FRONT", "BACK", "LEFT"], "camera_indices": np.array(cameras)}
    return TrainingInputs(dataclasses.replace(record, **rig), folder, [], [])


@pytest.mark.parametrize(
    ("cameras", "reference", "expected"),
    [
        ([0, 1, 2, 0, 1], "FRONT", ("BACK",)),
        ([0, 1, 2, 2, 1], "BACK", ("FRONT", "LEFT")),
        ([0, 0, 0, 0, 0], "FRONT", ()),
        ([0, 1, 2, 2, 1], None, ()),
    ],
)
def test_all_training_cameras_but_the_reference_have_an_exposure(tmp_path, cameras, reference, expected):
    job = TrainJob(parts=("background",), sky="none", train=TrainSettings(), random_seed=0, reference_camera=reference)
    inputs = inputs_of(tmp_path, cameras)
    assert inputs.exposed(job) == expected
    names = ["FRONT", "BACK", "LEFT"]
    assert [view_of(inputs.record, i, CPU).camera for i in range(5)] == [names[camera] for camera in cameras]


@pytest.mark.parametrize(
    ("cameras", "kind", "expected"),
    [
        (["CAM_FRONT", "CAM_BACK"], "affine", "CAM_BACK"),
        (["CAM_FRONT", "CAM_BACK"], "none", None),
        (["CAM_BACK"], "affine", "CAM_BACK"),
    ],
)
def test_the_evaluated_camera_is_the_reference(cameras, kind, expected):
    values = {"cameras": cameras, "eval_camera": "CAM_BACK", "train": {"exposure": {"kind": kind}}}
    job = TrainJob.model_validate_json(stage_settings(load(values), "train", "0061", "vanilla"))
    assert job.reference_camera == expected
    constant = {**values, "train": {"exposure": {"kind": kind, "interval": None}}}
    job = TrainJob.model_validate_json(stage_settings(load(constant), "train", "0061", "vanilla"))
    assert job.reference_camera == (expected if len(cameras) > 1 else None)


# ---- the demo world's cameras


def test_cameras_of_a_synthetic_rig_have_the_configured_exposure():
    """Where neither is clipped, encoded with a gamma of 2.2 the light is what the gains say."""
    gains = (1.4, 1.0, 0.6)
    plain, other = (recorder_of(exposures=e) for e in ({}, {"CAM_BACK": gains}))
    before, after = (recorder.image(RIG["CAM_BACK"], 0).astype(float) for recorder in (plain, other))
    clear = (before > 30) & (before < 190)
    for channel, gain in enumerate(gains):
        ratio = after[..., channel][clear[..., channel]] / before[..., channel][clear[..., channel]]
        assert np.median(ratio**2.2) == pytest.approx(gain, rel=0.02)
    front = RIG["CAM_FRONT"]
    np.testing.assert_array_equal(plain.image(front, 0), other.image(front, 0))
