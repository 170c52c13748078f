"""Training with LiDAR scans: which iterations fit one, the loss, and what is learned."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.hand_made import round_gaussians
from helpers.records import training_record_of
from helpers.trainings import (
    CPU,
    WALL_AT,
    folders_of,
    guided_views,
    job_of,
    recorded_views,
    scan_of_a_wall,
    settings_of,
    untrained,
    untrained_street,
)
from pydantic import ValidationError

from drivesplat.model.background import Background
from drivesplat.model.build import definitions, gaussian_cap, rebuild_model
from drivesplat.model.gaussians import GaussianSets
from drivesplat.model.parameters import OFFSETS
from drivesplat.model.scans import ScanPicture
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scan import Scan
from drivesplat.settings.train import McmcSettings, ScanTrainingSettings, TrainSettings
from drivesplat.training.graphs.captured_steps import IterationGraphs
from drivesplat.training.loop import Trainer, train
from drivesplat.training.optimizers import make_optimizers
from drivesplat.training.scans import (
    initial_lidar_logits,
    load_scans,
    scan_index,
    scan_terms,
    with_scan_points,
)
from drivesplat.training.schedule import Schedule
from drivesplat.training.stage import TrainingInputs, prepare
from drivesplat.training.step import limit_geometry

SCANS = ScanTrainingSettings(per_image=1.0)


def picture_of(scan, **changes) -> ScanPicture:
    """The rendering that equals a recorded scan, but for `changes`."""
    gaussians = SplatModel([round_gaussians([[0.0, 0.0, 5.0]])], None).at(0.0)
    ones = torch.ones_like(scan.range)
    exact = {"range": scan.range, "returned": scan.returned.float(), "intensity": scan.intensity, "alpha": ones}
    return ScanPicture(**{"sets": GaussianSets([gaussians]), **exact, "alpha_before": 0.0 * ones, **changes})


def terms_of(picture: ScanPicture, scan, **weights) -> dict[str, float]:
    settings = settings_of(opacity_reg=0.0, scale_reg=0.0, scans=ScanTrainingSettings(per_image=1.0, **weights))
    model = SplatModel([round_gaussians([[0.0, 0.0, 5.0]])], None)
    return {name: float(value) for name, value in scan_terms(picture, scan, model, settings).items()}


def scheduled(per_image: float, fine_tune: float = 0.0, images: int = 4, scans: int = 5) -> Schedule:
    """The schedule of a training with 300 iterations."""
    settings = settings_of(iterations=300, scans=ScanTrainingSettings(per_image=per_image, fine_tune=fine_tune))
    return Schedule.of(settings, images, scans)


@pytest.mark.parametrize("per_image", [0.0, 0.1, 1 / 3, 2.5])
def test_scans_are_spread_evenly_among_all_iterations_with_images(per_image):
    schedule = scheduled(per_image)
    steps = 300 + round(300 * per_image)
    fitted = [schedule.fits_scan(step) for step in range(steps)]
    assert schedule.steps == steps and sum(fitted) == schedule.scans_before(steps) == round(300 * per_image)
    assert schedule.images_before(steps) == schedule.iterations_before(steps) == 300
    assert not any(schedule.fine_tunes(step) for step in range(steps))
    share = per_image / (1.0 + per_image)
    for start in range(0, steps - 30, 30):
        assert abs(sum(fitted[start : start + 30]) - 30 * share) <= 1


def test_the_last_iterations_fine_tune_the_lidar():
    """Of 435 steps; learning rates, degrees, densification and averages end with the last image, step 375."""
    schedule = scheduled(0.25, fine_tune=0.2)
    assert schedule.steps == 300 + 75 + 60 and schedule.settings.iterations == 300, "settings keep their meaning"
    assert [schedule.fine_tunes(step) for step in (0, 374, 375, 434, 435)] == [False, False, True, True, False]
    assert sum(schedule.fits_scan(step) for step in range(375)) == 75 and schedule.images_before(375) == 300
    assert all(schedule.fits_scan(step) for step in range(375, 435))
    assert (schedule.scans_before(435), schedule.images_before(435), schedule.iterations_before(435)) == (135, 300, 300)
    assert not schedule.fits_scan(435), "beyond the end only images are fitted"
    assert [schedule.progress(step) for step in (0, 75, 375)] == [0.0, 0.2, 1.0]
    assert [schedule.step_at(fraction) for fraction in (0.0, 0.5, 1.0)] == [0, 187, 375]
    assert [schedule.fine_tuned(step) for step in (375, 405)] == [0.0, 0.5]
    every = schedule.step_at(schedule.settings.sh_every)
    assert [schedule.sh_degree(step, 2) for step in (every - 1, every, 2 * every, 400)] == [0, 1, 2, 2]


@pytest.mark.parametrize("changes", [{"scans": 0}, {"per_image": 0.0}, {"images": 0}])
def test_nothing_is_fine_tuned_without_scans_or_images(changes):
    """Without images every iteration fits a scan and counts."""
    schedule = scheduled(**{"per_image": 0.25, "fine_tune": 0.2, **changes})
    assert schedule.steps == 300 and not any(schedule.fine_tunes(step) for step in range(300))
    images = changes.get("images", 300)
    assert all(schedule.fits_scan(step) == (images == 0) for step in range(301))
    assert (schedule.images_before(300), schedule.scans_before(300)) == (images, 300 - images)
    assert schedule.iterations_before(300) == 300


def test_every_scan_is_taken_once_an_epoch_in_a_seeded_order():
    taken = [scan_index(5, before, seed=3) for before in range(20)]
    for epoch in range(0, 20, 5):
        assert sorted(taken[epoch : epoch + 5]) == [0, 1, 2, 3, 4]
    assert taken == [scan_index(5, before, seed=3) for before in range(20)]
    assert taken != [scan_index(5, before, seed=4) for before in range(20)]


def scan_trainer(iterations: int, street: bool = False, **scans: float) -> Trainer:
    """As many iterations with images as with scans, and some that fine-tune."""
    settings = settings_of(iterations=iterations, scans=ScanTrainingSettings(per_image=1.0, **scans))
    still = with_logits(settings, offsets=settings.scans.fine_tune > 0)
    model = untrained_street(settings, lidar_logits=(0.0, 2.0)) if street else still
    recorded = load_scans([scan_of_a_wall()], settings.scans, CPU)
    return Trainer.begin(model, guided_views()[:4], settings, 0, CPU, scans=recorded)


def test_every_image_is_taken_once_an_epoch_whatever_the_share_and_wanted_pictures_come_of_images():
    trainer = scan_trainer(60)
    numbers = [trainer.images.number(step) for step in range(16) if not trainer.schedule.fits_scan(step)]
    assert len(numbers) == 8 and sorted(numbers[:4]) == sorted(numbers[4:]) == [0, 1, 2, 3]
    trainer.state.step = 1
    terms, picture, view = trainer.training_step(with_picture=True)
    assert picture is not None and view is not None and "l1" in terms


def test_each_term_measures_its_own_error():
    """The worst ranges are ignored."""
    (scan,) = load_scans([scan_of_a_wall()], SCANS, CPU)
    wild = scan.range.clone()
    wild[0, 1:4] += 1000.0
    exact = terms_of(picture_of(scan, range=wild), scan)
    assert set(exact) == {"scan_range", "scan_drop", "scan_intensity", "scan_sight"}
    assert exact["scan_drop"] < 2e-5 and all(exact[name] == 0.0 for name in exact if name != "scan_drop")
    weights = {"range_weight": 2.0, "intensity_weight": 3.0, "drop_weight": 5.0, "sight_weight": 7.0}
    half = torch.full_like(scan.range, 0.5)
    for term, wrong, expected in (
        ("scan_range", {"range": scan.range + 0.25}, 0.5),
        ("scan_intensity", {"intensity": scan.intensity + 0.2}, 3.0 * 0.04),
        ("scan_drop", {"returned": half}, 5.0 * math.log(2.0)),
        ("scan_sight", {"alpha_before": half}, 3.5),
    ):
        assert terms_of(picture_of(scan, **wrong), scan, **weights)[term] == pytest.approx(expected, rel=1e-5), term


def test_rays_that_were_not_measured_have_no_effect():
    unmeasured = np.zeros((12, 30), dtype=bool)
    unmeasured[3:9] = True
    (scan,) = load_scans([dataclasses.replace(scan_of_a_wall(), measured=~unmeasured)], SCANS, CPU)
    rows = torch.from_numpy(unmeasured)
    wrong = {name: torch.where(rows, 9.0, getattr(scan, name)) for name in ("range", "intensity")}
    right, changed = picture_of(scan), picture_of(scan, returned=torch.where(rows, 0.3, scan.returned.float()), **wrong)
    assert terms_of(changed, scan) == terms_of(right, scan)


def test_a_scan_without_returns_or_intensity_has_a_finite_loss():
    empty, nothing = scan_of_a_wall(), np.zeros((12, 30), dtype=np.float32)
    (scan,) = load_scans([dataclasses.replace(empty, scan=Scan(empty.scan.rays, nothing > 0, nothing))], SCANS, CPU)
    none_met = torch.zeros_like(scan.range)
    terms = terms_of(picture_of(scan, returned=none_met, intensity=none_met), scan)
    assert "scan_intensity" not in terms and all(math.isfinite(value) for value in terms.values())
    assert load_scans([dataclasses.replace(empty, measured=nothing > 0)], SCANS, CPU) == []


def with_logits(settings: TrainSettings, offsets: bool = False) -> SplatModel:
    """The untrained model of `untrained`, with a LiDAR's logits."""
    return untrained(settings, lidar_logits=initial_lidar_logits([scan_of_a_wall()]), offsets=offsets)


def test_initial_lidar_logits_are_the_recorded_intensity_and_a_likely_return():
    intensity, returned = (torch.tensor(logit).sigmoid().item() for logit in initial_lidar_logits([scan_of_a_wall()]))
    assert intensity == pytest.approx(0.3, abs=1e-4) and returned == pytest.approx(0.9)
    without = dataclasses.replace(scan_of_a_wall().scan, intensities=None)
    unknown = initial_lidar_logits([dataclasses.replace(scan_of_a_wall(), scan=without)])
    assert torch.tensor(unknown[0]).sigmoid().item() == pytest.approx(0.5)


def test_the_beam_spread_is_in_radians():
    assert ScanTrainingSettings(beam_spread=(0.5, 2.0)).beam_spread_rad == (0.0005, 0.002)


def test_a_training_with_scans_learns_ranges_intensities_and_drops(tmp_path):
    settings = settings_of(iterations=120, scans=ScanTrainingSettings(per_image=1.0), opacity_reg=0.0, scale_reg=0.0)
    model, recorded = with_logits(settings), [scan_of_a_wall(x) for x in (-0.5, 0.0, 0.5)]
    scans = load_scans(recorded, settings.scans, CPU)

    summary = train(model, recorded_views(2), settings, 0, CPU, folders_of(tmp_path, "a"), scans=scans)
    with torch.no_grad():
        picture = model.scan(scans[1].view)
    known = scans[1].returned & (picture.alpha > 0.5)
    assert summary.iterations == summary.scan_iterations == 120 and known.sum() > 0.9 * scans[1].returned.sum()
    assert (picture.range - scans[1].range).abs()[known].median() < 0.2
    assert (picture.intensity - scans[1].intensity).abs()[known].median() < 0.05
    assert picture.returned[scans[1].returned].median() > 0.7 > 0.5 > picture.returned[~scans[1].returned].median()


SHAPE = {"means", "quats", "scales", "opacities"}


@pytest.mark.parametrize(
    ("step", "scans", "learned"),
    [
        pytest.param(0, {}, {*SHAPE, "sh0"}, id="an image"),
        pytest.param(1, {}, {*SHAPE, "lidar_logits"}, id="a scan"),
        pytest.param(1, {"geometry": 0.0}, {"means", "lidar_logits"}, id="a scan that leaves shapes alone"),
        pytest.param(1, {"geometry": 0.0, "fine_tune": 0.5}, {"means", "lidar_logits"}, id="also before fine-tuning"),
        pytest.param(7, {"fine_tune": 0.5}, {*SHAPE, "lidar_logits"}, id="the last before fine-tuning"),
        pytest.param(8, {"fine_tune": 0.5}, {"lidar_logits", *OFFSETS.values()}, id="fine-tuning"),
    ],
)
def test_each_kind_of_iteration_learns_its_own_parameters(step, scans, learned):
    """The noise of MCMC moves Gaussians until fine-tuning. Tracks are corrected by scans until then, too."""
    trainer = scan_trainer(4, street=True, **scans)
    model, fine_tunes = trainer.state.model, trainer.schedule.fine_tunes(step)
    before = {name: value.detach().clone() for name, value in model.named_parameters()}
    trainer.state.step = step
    assert trainer.schedule.fits_scan(step) == (step > 0) and fine_tunes == (step == 8)
    terms, picture, view = trainer.training_step(with_picture=fine_tunes)
    assert "l1" in terms if step == 0 else picture is None and view is None and "scan_range" in terms
    trainer.densify(picture)
    changed = {name for name, value in model.named_parameters() if not torch.equal(value, before[name])}
    still, actors = ({name.split(".")[-1] for name in changed if name.startswith(f"parts.{i}.")} for i in (0, 1))
    assert still == learned and ("lidar_logits" in actors) == (step > 0)
    if step >= 7:
        assert actors == {"lidar_logits"} if fine_tunes else {"translation", "yaw"} & actors


def test_checks_go_on_during_fine_tuning_and_densification_does_not(tmp_path, monkeypatch):
    """Lists of CUDA graphs may overflow there, too."""
    settings = settings_of(
        iterations=5, scans=ScanTrainingSettings(per_image=1.0, fine_tune=2.0), refine_start=0.0, refine_stop=1.0,
        mcmc=McmcSettings(refine_every=5),
    )  # fmt: skip
    recorded, checked, confined = load_scans([scan_of_a_wall()], settings.scans, CPU), [], []
    monkeypatch.setattr(IterationGraphs, "check", lambda _: checked.append(None))
    monkeypatch.setattr(Background, "confine", lambda _: confined.append(None))
    train(
        with_logits(settings, offsets=True), recorded_views(2), settings, 0, CPU, folders_of(tmp_path, "a"),
        scans=recorded,
    )  # fmt: skip
    assert (len(checked), len(confined)) == (4, 2)


def test_the_rates_of_fine_tuning_decay():
    trainer = scan_trainer(40, fine_tune=0.5)
    (group,) = trainer.state.optimizers.parts
    rates = trainer.state.model.parts[0].learning_rates()

    def share_of_rate(step: int, name: str) -> float:
        trainer.state.step = step
        trainer.state.begin_step()
        return group[name].param_groups[0]["lr"] / rates[name]

    assert [share_of_rate(step, "means") for step in (0, 40)] == pytest.approx([1.0, 0.1]), "ends with the images"
    assert [share_of_rate(step, "lidar_logits") for step in (79, 80, 90)] == pytest.approx([1.0, 6.0, 0.6])
    assert [share_of_rate(step, "lidar_scales") for step in (80, 90)] == pytest.approx([6.0, 0.6])
    assert [share_of_rate(step, "lidar_means") for step in (80, 90)] == pytest.approx([0.5, 0.05])


def test_fine_tuning_renders_scans_better_and_images_as_before():
    """Before and after the last iterations of a training, which fine-tune."""
    scans = ScanTrainingSettings(per_image=1 / 3, geometry=0.0, fine_tune=4 / 3, range_weight=1.0)
    settings = settings_of(iterations=30, scans=scans)
    recorded = load_scans([scan_of_a_wall(x) for x in (-0.5, 0.0, 0.5)], scans, CPU)
    model, views = with_logits(settings, offsets=True), recorded_views(4)
    trainer = Trainer.begin(model, views, settings, 0, CPU, scans=recorded)

    @torch.no_grad()
    def image_and_error() -> tuple[torch.Tensor, float]:
        picture, scan = model.scan(recorded[1].view), recorded[1]
        return model.render(views[0].view).image, float((picture.range - scan.range)[scan.returned].abs().median())

    while not trainer.schedule.fine_tunes(trainer.state.step):
        _, picture, _ = trainer.training_step(with_picture=False)
        trainer.densify(picture)
    image, error = image_and_error()
    while trainer.state.step < trainer.schedule.steps:
        _, picture, _ = trainer.training_step(with_picture=True)
        trainer.densify(picture)
    again, better = image_and_error()
    assert torch.equal(again, image) and better < 0.7 * error


@pytest.mark.parametrize("factor", [0.25, 0.0])
def test_a_factor_scales_the_gradients_of_what_images_show(factor):
    model = with_logits(settings_of())
    params = model.parts[0].params
    for parameter in params.values():
        parameter.grad = torch.ones_like(parameter)
    limit_geometry(model, factor)
    for name in SHAPE:
        if factor:
            assert (params[name].grad == factor).all(), name
        else:
            assert params[name].grad is None, "a step of Adam would move it on"
    assert (params["lidar_logits"].grad == 1.0).all()


def test_another_training_of_the_same_model_learns_everything_again(tmp_path):
    """Whatever the last iteration of the first one had left constant."""
    settings = settings_of(iterations=4, scans=ScanTrainingSettings(per_image=1.0, fine_tune=0.5))
    model, scans = with_logits(settings, offsets=True), load_scans([scan_of_a_wall()], settings.scans, CPU)
    learned = make_optimizers(model).parts[0].keys()
    train(model, recorded_views(2), settings, 0, CPU, folders_of(tmp_path, "a"), scans=scans)
    assert make_optimizers(model).parts[0].keys() == learned >= {"means", "lidar_logits", *OFFSETS.values()}


def test_cameras_do_not_see_what_lidar_sees_elsewhere():
    """Offsets of all background Gaussians by 0.5 m along the rays: the wall is farther for the LiDAR alone."""
    settings = settings_of(scans=ScanTrainingSettings(per_image=1.0, fine_tune=0.2), antialiased=False)
    model, (scan,) = with_logits(settings, offsets=True), load_scans([scan_of_a_wall()], settings.scans, CPU)
    (view, *_) = recorded_views(1)
    image, range_before = model.render(view.view).image, model.scan(scan.view).range
    with torch.no_grad():
        model.parts[0].params["lidar_means"][:, 2] = 0.5
    assert torch.equal(model.render(view.view).image, image)
    met = range_before > 1.0
    assert 0.3 < (model.scan(scan.view).range - range_before)[met].median() < 0.7
    again = rebuild_model(model.state_dict(), definitions(model), "none", settings)
    assert torch.equal(again.scan(scan.view).range, model.scan(scan.view).range), "offsets survive a checkpoint"
    with torch.no_grad():
        model.parts[0].params["lidar_opacities"].fill_(-20.0)
    assert model.scan(scan.view).alpha.max() < 1e-3 and torch.equal(model.render(view.view).image, image)


def test_scans_need_densification_by_mcmc():
    with pytest.raises(ValidationError, match=r"scans\.per_image needs strategy: mcmc"):
        TrainSettings(strategy="default", scans=SCANS)
    assert "lidar_logits" not in untrained(settings_of()).parts[0].params


def test_seed_points_are_added_where_scans_alone_met_static_surfaces():
    wall = scan_of_a_wall()
    moving = np.full(wall.objects.shape, -1, dtype=np.int16)
    moving[:6] = 0
    wall = dataclasses.replace(wall, objects=moving, linear=np.array([0.0, 0.0, 5.0]))
    known = np.array([[0.0, 0.0, WALL_AT]], dtype=np.float32)
    record = training_record_of(2, points=known, points_rgb=np.array([[10, 20, 30]], dtype=np.uint8))
    found = with_scan_points(record, [wall], ScanTrainingSettings(per_image=1.0), seed=0)
    added = found.points[1:]
    assert len(added) > 20 and np.array_equal(found.points[:1], known) and found.points.dtype == np.float32
    np.testing.assert_allclose(added[:, 2], WALL_AT, atol=1e-4)
    assert (added[:, 1] < 0.02).all(), "the lower half of the rays met something that moves"
    assert np.linalg.norm(added - known, axis=1).min() > 0.5 and (found.points_rgb == [10, 20, 30]).all()
    few = with_scan_points(record, [wall], ScanTrainingSettings(per_image=1.0, points=7), seed=0)
    assert len(few.points) == 8 and np.isin(few.points[1:, 0], added[:, 0]).all()


def test_the_points_of_a_scan_are_where_its_rays_met_them_at_their_own_times():
    still = scan_of_a_wall(0.5)
    rays = dataclasses.replace(still.scan.rays, offsets_s=np.full((12, 30), 0.1, dtype=np.float32))
    moving = dataclasses.replace(
        still, scan=dataclasses.replace(still.scan, rays=rays), linear=np.array([2.0, 0.0, 0.0]),
        angular=np.array([0.0, 0.0, 0.5]),
    )  # fmt: skip
    turned, standing = moving.points(), still.points()
    ranges = still.scan.ranges[still.scan.returned]
    np.testing.assert_allclose(np.linalg.norm(standing - [0.5, 0.0, 0.0], axis=1), ranges, rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(turned - [0.5, 0.0, 0.2], axis=1), ranges, rtol=1e-5)
    left = still.scan.rays.azimuths[still.scan.returned]
    np.testing.assert_allclose(np.arctan2(-(turned[:, 0] - 0.5), turned[:, 2] - 0.2), left + 0.05, atol=1e-4)


def without_images() -> TrainingInputs:
    """Scans of a wall from three places, and no image."""
    record = training_record_of(0, points=np.empty((0, 3), np.float32), points_rgb=np.empty((0, 3), np.uint8))
    scans = [scan_of_a_wall(x) for x in (-0.5, 0.0, 0.5)]
    return TrainingInputs(record, None, [], [], sky_known=False, scans=scans)


def test_without_images_every_iteration_fits_a_scan(tmp_path):
    """Also those that would show a picture; the seed is that of scans, and the path that is kept empty the LiDAR's."""
    changes = {"iterations": 30, "image_every": 10, "psnr_every": 10, "log_every": 10, "pixels_per_gaussian": 20}
    job = job_of(**changes, scans=ScanTrainingSettings(per_image=1.0))
    begun = prepare(without_images(), job, CPU)
    assert begun.views == [] and begun.curves == [] and len(begun.model) > 100
    scan = begun.scans[1]

    @torch.no_grad()
    def share_and_error() -> tuple[float, float]:
        """The mean probability of the recorded returns, and the median error of their ranges."""
        picture, there = begun.model.scan(scan.view), scan.returned
        return float(picture.returned[there].mean()), float((picture.range - scan.range)[there].abs().median())

    before, _ = share_and_error()
    trained = train(begun.model, [], begun.settings, 0, CPU, folders_of(tmp_path, "a"), scans=begun.scans)
    after, error = share_and_error()
    assert trained.iterations == 30 and after > before + 0.1 and error < 0.05
    trainer = Trainer.begin(begun.model, [], begun.settings, 0, CPU, scans=begun.scans)
    np.testing.assert_allclose(trainer.sensor_positions[:, 0], [-0.5, 0.0, 0.5])


def test_without_images_iterations_with_scans_flatten_surfaces():
    """Without images the terms of surfaces belong to the iterations that fit scans. No road is known."""
    scans = ScanTrainingSettings(per_image=1.0)

    def terms(inputs: TrainingInputs, **changes: float) -> set[str]:
        begun = prepare(inputs, job_of(iterations=10, **changes, scans=scans), CPU)
        trainer = Trainer.begin(begun.model, begun.views, begun.settings, 0, CPU, begun.road, scans=begun.scans)
        return set(trainer.training_step()[0])

    surfaces = {"flatness_weight": 0.1, "road_weight": 0.1}
    assert terms(without_images(), **surfaces) - terms(without_images()) == {"flatness"}


def test_without_images_rays_limit_the_number_of_gaussians_as_pixels_do():
    inputs = without_images()
    rays = sum(int(scan.measured.sum()) for scan in inputs.scans)
    assert gaussian_cap(inputs.record, settings_of(cap_max=10_000, pixels_per_gaussian=20.0), rays) == rays // 20
    assert gaussian_cap(inputs.record, settings_of(cap_max=10_000, pixels_per_gaussian=0.0), rays) == 10_000
    beside_images = training_record_of(2, image_sizes=np.tile([64, 48], (2, 1)))
    assert gaussian_cap(beside_images, settings_of(cap_max=10_000, pixels_per_gaussian=20.0), rays) == 2 * 64 * 48 // 20
