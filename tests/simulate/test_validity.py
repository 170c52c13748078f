"""How far images from off the recorded path can be trusted, on a street of which is known what training images saw."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z, round_gaussians
from helpers.hand_made_drive import K, drive_of
from helpers.hand_made_street import AHEAD, street_actors, street_model, street_scene
from helpers.records import training_record_of
from scipy.spatial.transform import Rotation

from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.errors import RequestError, ResultError
from drivesplat.model.gaussians import concatenate
from drivesplat.model.view import View, view_of
from drivesplat.scene.images import write_png
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.simulate import seen_from
from drivesplat.simulate.seen_from import MIN_IMAGES, SeenGaussians, Sides, may_show, reduced
from drivesplat.simulate.validity import HALVING_DB, UNSEEN_ERROR, ViewKnowledge, ViewValidity

MIDDLE = 8
"""The number of a training image in the middle of the drive, at 9.6 m of a path along x."""
WALL_AT = 60.0


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


def grid(x: Sequence[float], y: Sequence[float], z: Sequence[float]) -> np.ndarray:
    return np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)


def street_places(end_wall: bool = True) -> np.ndarray:
    """A road, a facade on either side, and perhaps a wall across the end; behind it another one, wider than a camera
    between the two sees."""
    along, across, up = np.arange(-4.0, WALL_AT, 0.8), np.arange(-8.0, 8.1, 0.8), np.arange(0.0, 8.1, 0.8)
    walls = [grid(along, across, [0.0]), grid(along, [-8.0], up), grid(along, [8.0], up)]
    behind = grid([WALL_AT + 12.0], np.arange(-12.0, 12.1, 0.8), np.arange(-8.0, 12.1, 0.8))
    return np.concatenate([*walls, *([grid([WALL_AT], across, up)] if end_wall else []), behind])


def drive_with(
    scene: Scene, folder: Path, end_wall: bool = True, held_out: Sequence[int] = (), train: Sequence[int] | None = None
) -> TrainedDrive:
    """The street with all but the `held_out` images for training, or only those of `train`."""
    model = street_model(round_gaussians(street_places(end_wall), 0.5, 0.98), street_actors())
    count, drive = len(scene.frames), drive_of(scene, model, folder)
    chosen = [i for i in range(count) if i not in held_out] if train is None else train
    record = training_record_of(
        count,
        Ks=np.tile(K, (count, 1, 1)),
        camtoworlds=np.array([frame.camera_to_world for frame in scene.frames]),
        timestamps=np.array([frame.timestamp for frame in scene.frames]),
        image_paths=[str(folder / f"{i}.png") for i in range(count)],
        splits={"train": np.array(chosen, dtype=int), "interpolation": np.array(held_out, dtype=int)},
    )
    return dataclasses.replace(drive, recording=dataclasses.replace(drive.recording, record=record))


@pytest.fixture(scope="module")
def drive(scene, tmp_path_factory) -> TrainedDrive:
    return drive_with(scene, tmp_path_factory.mktemp("without_images"))


@pytest.fixture(scope="module")
def known(drive) -> ViewKnowledge:
    return ViewKnowledge.of_drive(drive)


def view_from(
    drive: TrainedDrive, offset: Sequence[float] = (0.0, 0.0, 0.0), yaw: float = 0.0, pitch: float = 0.0,
    index: int = MIDDLE,
) -> View:  # fmt: skip
    """The view of an image, moved by an offset in the world (metres) and turned to the left and up (degrees)."""
    view = view_of(drive.record, index, drive.device)
    turn = rigid(Rotation.from_euler("yx", [-yaw, pitch], degrees=True).as_matrix(), np.zeros(3))
    pose = view.camera_to_world.double().numpy() @ turn
    pose[:3, 3] += offset
    return dataclasses.replace(view, camera_to_world=torch.from_numpy(pose).float())


def found_at(known: ViewKnowledge, view: View) -> ViewValidity:
    return known.validity(known.drive.state(view.time), view)


# ---- from where a camera looks


@pytest.mark.parametrize("index", [4, MIDDLE, 14])
def test_an_image_from_a_training_camera_is_as_good_as_training_images(known, drive, index):
    found = found_at(known, view_from(drive, index=index))
    assert found.distance == found.angle == 0.0 and found.aside == 0.0
    assert found.validity > 0.97 and abs(found.drop) < 0.2
    assert found.unseen < 0.01 and found.turned == 0.0


def test_most_of_an_image_on_the_path_was_seen_by_several_training_images(known, drive):
    assert found_at(known, view_from(drive)).supported > 0.5


def test_validity_falls_as_the_camera_moves_aside(known, drive):
    found = [found_at(known, view_from(drive, (0.0, metres, 0.0))) for metres in (0.0, 1.0, 2.0, 4.0, 6.5)]
    assert [one.aside for one in found] == pytest.approx([0.0, 1.0, 2.0, 4.0, 6.5], abs=1e-4)
    assert (np.diff([one.validity for one in found]) < -0.01).all()
    assert (np.diff([one.supported for one in found]) < 0.0).all()
    assert (np.diff([one.drop for one in found]) > 0.0).all()


def test_validity_falls_as_the_camera_turns(known, drive):
    found = [found_at(known, view_from(drive, yaw=degrees)) for degrees in (0.0, 20.0, 50.0, 90.0, 130.0)]
    assert [one.angle for one in found] == pytest.approx([0.0, 20.0, 50.0, 90.0, 130.0], abs=1e-3)
    assert (np.diff([one.validity for one in found]) < -0.01).all()
    assert found[-1].validity < 0.3


@pytest.mark.parametrize("offset", [(0.0, 0.0, -20.0), (0.0, 1000.0, 0.0), (0.0, 0.0, 1000.0), (-1000.0, 0.0, 0.0)])
def test_what_was_never_seen_is_worth_nothing(known, drive, offset):
    """Underground, and far away to the side, above and behind, looking at the street or along its path."""
    views = [view_from(drive, offset)]
    if offset[1] or offset[2] > 0.0:
        views.append(view_from(drive, offset, yaw=-90.0 if offset[1] else 0.0, pitch=-89.0 if offset[2] else 0.0))
    for view in views:
        found = found_at(known, view)
        assert found.validity < 0.1 and found.supported < 0.6
        assert found.distance > 15.0 and found.aside == pytest.approx(np.linalg.norm(offset), abs=15.0)


def test_distance_is_that_to_the_nearest_training_camera(scene, tmp_path):
    """Held-out images lie on the path, but not at a training camera."""
    sparse = drive_with(scene, tmp_path, train=[0, 18])
    found = found_at(ViewKnowledge.of_drive(sparse), view_from(sparse, (0.0, 3.0, 0.0), index=4))
    assert found.distance == pytest.approx(5.0, abs=1e-4) and found.aside == pytest.approx(3.0, abs=1e-4)


# ---- what it sees


def test_gaussians_that_no_image_saw_lower_it(scene, tmp_path, drive, known):
    """The wall behind the end of the street, from between the two: with that end, no training image saw it."""
    open_street = drive_with(scene, tmp_path, end_wall=False)
    offset = (WALL_AT + 3.0 - 9.56, 0.0, 0.0)
    hidden = found_at(known, view_from(drive, offset))
    seen = found_at(ViewKnowledge.of_drive(open_street), view_from(open_street, offset))
    assert hidden.unseen > 0.9 and hidden.validity < 0.01
    assert seen.unseen < 0.6 and seen.validity > 0.1


def test_an_object_that_is_turned_round_lowers_it(known, drive):
    view = view_from(drive)
    as_recorded = found_at(known, view)
    world = drive.state(view.time)
    car = world.actors[AHEAD]
    pose = car.pose
    pose[:3, 3] = view.camera_to_world[:3, 3].double().numpy() + np.array([7.0, 0.0, -0.5])
    car.pose = pose
    closer = known.validity(world, view)
    pose[:3, :3] = about_z(np.pi) @ pose[:3, :3]
    car.pose = pose
    turned = known.validity(world, view)
    assert as_recorded.turned == closer.turned == 0.0
    assert turned.turned > 0.005 and turned.validity < closer.validity
    assert turned.unseen == pytest.approx(closer.unseen, abs=1e-4) and turned.supported < closer.supported + 1e-6


def test_a_copy_of_an_object_was_seen_from_where_its_source_was(known, drive):
    view = view_from(drive)
    found = []
    for turn in (0.0, np.pi):
        world = drive.state(view.time)
        pose = rigid(about_z(turn), view.camera_to_world[:3, 3].double().numpy() + np.array([7.0, 3.0, -0.5]))
        world.add(AHEAD, "copy", pose)
        found.append(known.validity(world, view))
    assert found[0].turned == 0.0 < found[1].turned


def test_what_was_seen_of_an_edited_drive_is_that_of_the_recorded_one(known, drive):
    edited = drive.edited([{"shift": {"track": AHEAD, "yaw": 180.0}}])
    knows_edited = ViewKnowledge.of_drive(edited)
    found, before = found_at(knows_edited, view_from(drive)), found_at(known, view_from(drive))
    assert found.turned > 0.0 == before.turned and found.validity < before.validity
    assert knows_edited.reference == pytest.approx(known.reference)


def test_sky_that_was_seen_is_known_and_other_sky_is_not(known, drive):
    """Training images see the sky above the wall at the end; none looks up."""
    upwards = found_at(known, view_from(drive, pitch=80.0))
    assert upwards.unseen > 0.9 and upwards.validity < 0.05
    assert found_at(known, view_from(drive)).unseen < 0.01


def test_static_gaussians_are_known_whatever_part_they_belong_to(scene, tmp_path, known):
    places = street_places()
    halves = [round_gaussians(own, 0.5, 0.98) for own in (places[:1000], places[1000:])]
    halves[1].name = "more"
    two_parts = drive_with(scene, tmp_path)
    two_parts = dataclasses.replace(two_parts, model=street_model(*halves, street_actors()))
    knows_two = ViewKnowledge.of_drive(two_parts)
    for offset in ((0.0, 3.0, 0.0), (WALL_AT + 3.0 - 9.56, 0.0, 0.0)):
        one, two = (found_at(of, view_from(of.drive, offset)) for of in (known, knows_two))
        assert dataclasses.astuple(two) == pytest.approx(dataclasses.astuple(one), abs=1e-4)


# ---- figures in dB


def test_errors_grow_with_metres_aside_direction_and_scale_as_documented(known):
    sides = Sides(torch.tensor([True, True, True, False]), torch.deg2rad(torch.tensor([0.0, 10.0, 0.0, 40.0])),
                  torch.tensor([0.5, 1.0, 9.0, 1.0]))  # fmt: skip
    errors = dataclasses.replace(known.errors, growth=2.0)
    on_path, aside = (errors.expected(sides, torch.full((4,), 0.002), metres) for metres in (0.0, 5.0))
    torch.testing.assert_close(on_path, torch.tensor([0.002, 0.006, 0.002 * (1.0 + 2.0 * 0.25 * 3.0), UNSEEN_ERROR]))
    torch.testing.assert_close(aside[:3], 1.5 * on_path[:3])
    assert aside[3] == on_path[3]


def with_images(drive: TrainedDrive, error: float) -> TrainedDrive:
    """Recorded images that differ from renderings by `error` in all channels, as 8 bits allow."""
    for index in drive.record.train_images:
        view = view_of(drive.record, index, drive.device)
        image = np.clip(drive.model.render(view).image.clamp(0.0, 0.9).double().numpy() + error, 0.0, 1.0)
        write_png(Path(drive.record.image_paths[index]), np.round(255.0 * image).astype(np.uint8))
    return drive


def test_errors_of_training_images_are_expected_where_they_were_made(scene, tmp_path):
    recorded = with_images(drive_with(scene, tmp_path), 0.05)
    known = ViewKnowledge.of_drive(recorded)
    at_camera, aside = (found_at(known, view_from(recorded, (0.0, metres, 0.0))) for metres in (0.0, 3.0))
    assert known.is_absolute
    assert at_camera.expected_psnr == pytest.approx(-20.0 * np.log10(0.05), abs=0.5)
    low, high = at_camera.interval
    assert low < at_camera.expected_psnr < high
    assert aside.expected_psnr < at_camera.expected_psnr - 1.0
    assert aside.drop == pytest.approx(-aside.expected_psnr - 10.0 * np.log10(known.reference))


def write_metrics(drive: TrainedDrive, psnr: float) -> None:
    drive.folder.mkdir(exist_ok=True)
    result = {"interpolation": {"all": {"psnr_frame_mean": psnr}}, "extrapolation": None}
    content = {"protocol": {"eval_camera": "CAM_FRONT"}, "result": result}
    (drive.folder / "eval.json").write_text(json.dumps(content))


@pytest.mark.parametrize(("psnr", "images"), [(20.0, True), (30.0, True), (20.0, False)])
def test_held_out_images_have_the_psnr_that_was_measured(scene, tmp_path, psnr, images):
    """Whether or not the growth of errors explains it: training images have 26 dB."""
    held_out = drive_with(scene, tmp_path, held_out=[7, 8, 9])
    known = ViewKnowledge.of_drive(with_images(held_out, 0.05) if images else held_out)
    assert not known.is_absolute or images
    write_metrics(held_out, psnr)
    known = ViewKnowledge.of_drive(held_out)
    found = [found_at(known, view_from(held_out, index=index)) for index in (7, 8, 9)]
    assert np.mean([one.expected_psnr for one in found]) == pytest.approx(psnr, abs=0.02)
    assert np.mean([one.drop for one in found]) == pytest.approx(0.0, abs=1e-3)
    assert found_at(known, view_from(held_out, (0.0, 4.0, 0.0))).expected_psnr < psnr - 0.5


def test_without_images_and_metrics_there_are_no_figures_in_db(known, drive):
    found = found_at(known, view_from(drive))
    assert found.expected_psnr is None and found.interval is None and np.isfinite(found.drop)


def test_validity_halves_with_every_six_decibels(known, drive):
    """But for the share that no image saw."""
    found = found_at(known, view_from(drive, (0.0, 2.0, 0.0)))
    worse = dataclasses.replace(known, reference=known.reference / 10 ** (HALVING_DB / 10.0))
    assert found_at(worse, view_from(drive, (0.0, 2.0, 0.0))).validity == pytest.approx(found.validity / 2.0)
    better = dataclasses.replace(known, reference=known.reference * 10.0)
    assert found_at(better, view_from(drive)).validity <= 1.0


def test_an_image_of_nothing_known_has_the_error_of_what_was_not_seen(scene, tmp_path):
    known = ViewKnowledge.of_drive(with_images(drive_with(scene, tmp_path), 0.05))
    found = found_at(known, view_from(known.drive, (0.0, 0.0, 2000.0), pitch=80.0))
    assert found.expected_psnr == pytest.approx(-10.0 * np.log10(UNSEEN_ERROR), abs=0.05)


# ---- drives with little


def test_a_drive_without_training_images_is_refused(scene, tmp_path):
    with pytest.raises(RequestError, match="has no training images"):
        ViewKnowledge.of_drive(drive_with(scene, tmp_path, train=[]))


def test_a_single_training_image_supports_nothing_but_is_a_reference(scene, tmp_path):
    assert MIN_IMAGES == 2
    single = drive_with(scene, tmp_path, train=[MIDDLE])
    known = ViewKnowledge.of_drive(single)
    at_camera, aside = (found_at(known, view_from(single, (0.0, metres, 0.0))) for metres in (0.0, 3.0))
    assert at_camera.validity > 0.97 and aside.validity < 0.8
    assert at_camera.supported == pytest.approx(known._means_of_image(MIDDLE).sky)


def test_invalid_metrics_are_named(scene, tmp_path):
    held_out = drive_with(scene, tmp_path, held_out=[4])
    held_out.folder.mkdir()
    content = {"protocol": {"eval_camera": "CAM_FRONT"}, "result": {"interpolation": 3}}
    (held_out.folder / "eval.json").write_text(json.dumps(content))
    with pytest.raises(ResultError, match=r"eval\.json: not a record of metrics"):
        ViewKnowledge.of_drive(held_out)


def test_the_world_of_another_drive_is_refused(known, scene, tmp_path):
    other = drive_with(scene, tmp_path)
    with pytest.raises(RequestError, match="not one of"):
        known.validity(other.state(1.0), view_from(other))


# ---- what is computed once


def test_sides_are_those_of_every_pair_of_gaussian_and_camera(monkeypatch):
    """Against a computation of angles and scales one by one."""
    rng = np.random.default_rng(0)
    means, centers = rng.uniform([10, -10, -10], [30, 10, 10], (40, 3)), rng.uniform(-6, 6, (7, 3))
    seen, focal, place = rng.random((40, 7)) < 0.4, rng.uniform(30.0, 90.0, 7), np.array([1.0, -2.0, 0.5])
    known = SeenGaussians(*(torch.from_numpy(a) for a in (seen, centers.astype("f4"), focal.astype("f4"))), None)
    arguments = torch.from_numpy(means).float(), torch.arange(40), torch.from_numpy(place).float(), torch.tensor(80.0)
    monkeypatch.setattr(seen_from, "MAX_PAIRS", 35)  # five Gaussians at once
    found = known.sides(*arguments)
    for i in range(40):
        here, there = place - means[i], centers - means[i]
        lengths = np.linalg.norm(there, axis=1)
        angles = np.degrees(np.arccos(there @ here / lengths / np.linalg.norm(here)))
        scales = (80.0 / np.linalg.norm(here)) / (focal / lengths)
        assert found.similar[i] == (((angles <= 20.0) & (scales <= 2.0) & seen[i]).sum() >= 2)
        turn = min(angles[seen[i]].min(initial=180.0), 40.0)
        assert float(found.turn[i]) == pytest.approx(np.radians(turn), abs=1e-3)
        assert float(found.magnification[i]) == pytest.approx(scales[seen[i]].min(initial=np.inf), rel=1e-4)
        assert found.unseen[i] == (turn == 40.0)
    monkeypatch.setattr(seen_from, "MAX_NEAREST", 3)
    nearest = np.argsort(np.linalg.norm(centers - place, axis=1))[:3]
    few = dataclasses.replace(known, seen=known.seen & torch.isin(torch.arange(7), torch.from_numpy(nearest)))
    limited = known.sides(*arguments)
    monkeypatch.setattr(seen_from, "MAX_NEAREST", 7)
    expected = few.sides(*arguments)
    assert torch.equal(limited.similar, expected.similar) and torch.allclose(limited.turn, expected.turn)


def test_gaussians_that_are_left_out_show_in_no_pixel(drive):
    view = view_from(drive, (0.0, 5.0, 0.0), yaw=40.0)
    gaussians = concatenate(drive.state(view.time).placed().sets_in(view))
    kept = may_show(view, gaussians)
    ones = torch.ones(len(gaussians), 1)
    whole = drive.model.composited(gaussians, ones, view).alpha
    part = drive.model.composited(gaussians[kept], ones[kept], view).alpha
    assert len(kept) < 0.7 * len(gaussians)
    torch.testing.assert_close(part, whole, atol=0.02, rtol=0.0)


def test_of_many_training_images_as_many_are_looked_at_as_memory_allows(drive, monkeypatch):
    monkeypatch.setattr(seen_from, "MAX_IMAGES", 4)
    assert seen_from.training_images(drive.record) == [0, 6, 12, 18]


def test_a_small_image_shows_the_same_directions(drive):
    view = view_from(drive)
    small = reduced(view, 16)
    assert (small.width, small.height) == (16, 12) and reduced(view, 1000).width == view.width
    corners = view.rays()[1::4, 1::4], view.rays()[2::4, 2::4]
    middle = torch.nn.functional.normalize(corners[0] + corners[1], dim=-1)
    torch.testing.assert_close(small.rays(), middle, atol=1e-3, rtol=0.0)
