"""Drives that nobody recorded, as drive folders and as nuScenes tables: what other programs read of them."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers import drives
from helpers.hand_made_street import (
    AHEAD,
    DRIVERS,
    GONE,
    KEY,
    SPEED,
    TURNING,
    checkpoint_of,
    straight,
)
from helpers.samples import sampled_with
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.geometry_utils import view_points
from PIL import Image, ImageDraw
from scipy.spatial import ConvexHull

from drivesplat.editing.drive_folder import TABLES, VERSION, write_rendered_drive
from drivesplat.editing.render_plan import image_render_plan
from drivesplat.errors import ResultError
from drivesplat.io.storage import unwritable
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.model.view import View
from drivesplat.readers.drive.check import check, whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.nuscenes.reader import read
from drivesplat.rendering.frames import film_frame
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.export import DriveJob
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.render import TrajectorySettings

STEPS = [
    {"shift": {"track": AHEAD, "lateral": 2.0}},
    {"duplicate": {"track": "6e5c", "as": "twin", "longitudinal": -6.0}},
    {"remove": {"track": TURNING}},
    {"rescale": {"track": GONE, "factor": 1.3}},
]
SOURCE = {"scene": "0001", "method": "street", "edit": "busy"}
ASIDE = rigid(np.eye(3), np.array([0.0, 2.0, 0.0]))
HOLDOUT = HoldoutSettings(every_nth=0, last_block=2)
"""Of the tiny drive's ten key frames."""


def a_job(*steps: dict[str, Any], width: int | None = 64, trajectory: TrajectorySettings | None = None) -> DriveJob:
    return DriveJob(
        eval_camera="CAM_FRONT",
        cameras=("CAM_FRONT",),
        images=ImageSettings(width=32),
        holdout=HOLDOUT,
        width=width,
        edit=Edit.model_validate({"steps": steps}) if steps else None,
        trajectory=trajectory,
    )


def written(scene: Scene, model: SplatModel, folder: Path, job: DriveJob, source: dict[str, str] = SOURCE) -> Path:
    path = folder / "drive" / "drive.json"
    cpu = DeviceSettings(kind="cpu")
    write_rendered_drive(scene, checkpoint_of(model), job, cpu, path, source, {"stage": "drive_folder"})
    return path.parent


def shown_by(model: SplatModel, frame: Frame, scene: Scene, placed: list[ActorPlacement]) -> np.ndarray:
    """An image (h, w, 3) int of the model with these actors and no others."""
    view = View(
        torch.from_numpy(continuous_intrinsics(frame, (frame.width, frame.height))).float(),
        torch.from_numpy(frame.camera_to_world).float(),
        frame.width,
        frame.height,
        time=scene.seconds(frame.timestamp),
    )
    return film_frame(model, view, sampled_with(model, view.time, placed)).astype(int)


def as_read(folder: Path) -> Scene:
    return whole_scene(read_drive(folder), folder)


def tables_as_read(folder: Path, name: str) -> Scene:
    cameras = ("CAM_FRONT",)
    source = drives.source(dataset="", version=VERSION, scene=name, cameras=cameras, lidar_sweeps=False)
    return read(folder / TABLES, source)


@pytest.fixture(scope="module")
def busy(scene, model, tmp_path_factory) -> Path:
    return written(scene, model, tmp_path_factory.mktemp("busy"), a_job(*STEPS))


def test_the_folder_has_no_faults_and_says_that_it_was_rendered(busy, scene):
    assert check(busy, None) == []
    drive = read_drive(busy)
    assert drive.rendered.model_dump(exclude={"steps", "trained_until", "shown_by", "provenance"}) == {
        **SOURCE,
        "trajectory": None,
        "run": None,
        "seed": None,
        "instances": None,
    }
    assert [list(step) for step in drive.rendered.steps] == [["shift"], ["duplicate"], ["remove"], ["rescale"]]
    assert drive.rendered.provenance == {"stage": "drive_folder"}
    trained = [frame.timestamp for frame in scene.frames if frame.camera == "CAM_FRONT" and frame.sample_index < 8]
    assert drive.rendered.trained_until == max(trained)
    assert as_read(busy).description.startswith("Rendered by drivesplat, not recorded (scene 0001 method street edit")
    beside_tables = json.loads((busy / TABLES / "provenance.json").read_text())
    assert beside_tables["rendered"]["edit"] == "busy"


def test_images_are_at_the_recorded_times_and_places_and_equal_the_model_s_rendering(busy, scene, model):
    read_back = as_read(busy)
    recorded = sorted((f for f in scene.frames if f.camera == "CAM_FRONT"), key=lambda frame: frame.timestamp)
    assert [frame.timestamp for frame in read_back.frames] == [frame.timestamp for frame in recorded]
    for frame, origin in zip(read_back.frames, recorded, strict=True):
        assert (frame.width, frame.height) == (64, round(origin.height * 64 / origin.width))
        np.testing.assert_allclose(frame.camera_to_world, origin.camera_to_world, atol=1e-9)
        np.testing.assert_allclose(frame.ego_to_world, origin.ego_to_world, atol=1e-9)
        field_of_view = [frame.width / frame.intrinsics[0, 0], origin.width / origin.intrinsics[0, 0]]
        assert field_of_view[0] == pytest.approx(field_of_view[1])
    frame = read_back.frames[1]
    seconds = scene.seconds(frame.timestamp)
    assert seconds == pytest.approx(0.25)
    shown = [ActorPlacement(AHEAD, straight(at) @ ASIDE, 1.0) for at in (seconds, seconds - 6.0 / SPEED)]
    expected = shown_by(model, frame, scene, shown)
    pixels = np.asarray(Image.open(frame.image_path)).astype(int)
    assert np.abs(pixels - expected).mean() < 3.0
    without = shown_by(model, frame, scene, [])
    assert np.abs(pixels - without).mean() > 2 * np.abs(pixels - expected).mean()


@pytest.mark.parametrize("steps", [(), STEPS])
def test_label_images_show_where_objects_are_and_how_far(steps, scene, model, tmp_path):
    """The pixels of an object are those that change most where it is removed; depths there are those of its box."""
    job = a_job(*steps, trajectory=None if steps else TrajectorySettings())
    folder = written(scene, model, tmp_path, job.model_copy(update={"labels": ("depth", "instances")}))
    read_back, numbers = as_read(folder), read_drive(folder).rendered.instances
    assert set(numbers) >= {AHEAD, GONE} and ("twin" in numbers) == bool(steps)
    frame = read_back.frames[1]
    name = Path(frame.image_path).with_suffix(".png").name
    depth, instances = (np.asarray(Image.open(folder / kind / "CAM_FRONT" / name)) for kind in ("depth", "instances"))
    assert depth.dtype == instances.dtype == np.uint16 and depth.shape == (frame.height, frame.width)
    seconds = scene.seconds(frame.timestamp)
    others = [] if steps else [ActorPlacement(TURNING)]
    shift = ASIDE if steps else np.eye(4)
    own = ActorPlacement(AHEAD, straight(seconds) @ shift, 1.0)
    more = [ActorPlacement(AHEAD, straight(seconds - 6.0 / SPEED) @ shift, 1.0)] if steps else others
    changed = np.abs(
        shown_by(model, frame, scene, [own, *more]) - shown_by(model, frame, scene, more)
    ).max(axis=2)  # fmt: skip
    mine = instances == numbers[AHEAD]
    assert mine.any() and (changed[mine] > 0).all() and changed[mine].mean() > 4 * changed[~mine].mean()
    ahead = np.linalg.norm((straight(seconds) @ shift)[:2, 3] - frame.camera_to_world[:2, 3])
    assert np.median(depth[mine]) / 256.0 == pytest.approx(ahead, abs=2.5)


def test_tracks_hold_every_object_after_the_edit_at_key_frames_and_between(busy, scene):
    drive, read_back = read_drive(busy), as_read(busy)
    assert {track.id for track in read_back.tracks} == {AHEAD, GONE, "twin"}, "those with Gaussians of their own"
    for name, delay in ((AHEAD, 0.0), ("twin", 6.0 / SPEED)):
        track = read_back.track(name)
        assert track.object_class.value == "car" and set(track.visibility) <= {1, 2, 3, 4}
        np.testing.assert_allclose(track.object_to_world, [straight(t - delay) @ ASIDE for t in KEY], atol=1e-6)
        (timed,) = (one for one in drive.tracks if one.id == name)
        times = np.array([pose.timestamp for pose in timed.poses])
        assert np.diff(times).max() <= 100_000 and set(scene.key_frame_timestamps) <= set(times)
        positions = [straight(scene.seconds(time) - delay) @ ASIDE for time in times]
        np.testing.assert_allclose([p.translation for p in timed.poses], np.array(positions)[:, :3, 3], atol=1e-6)
    truck = read_back.track(GONE)
    np.testing.assert_allclose(truck.size, 1.3 * np.array(DRIVERS[GONE].size))
    assert truck.sample_indices.tolist() == [*DRIVERS[GONE].seen]


def test_nuscenes_devkit_and_the_nuscenes_reader_load_the_same_drive(busy, scene):
    drive, tables = as_read(busy), tables_as_read(busy, "0001_busy")
    np.testing.assert_array_equal(tables.key_frame_timestamps, drive.key_frame_timestamps)
    shift = tables.origin - drive.origin
    for ours, theirs in zip(drive.frames, tables.frames, strict=True):
        assert (ours.timestamp, ours.is_key_frame) == (theirs.timestamp, theirs.is_key_frame)
        np.testing.assert_allclose(theirs.camera_to_world[:3, 3] + shift, ours.camera_to_world[:3, 3], atol=1e-6)
        np.testing.assert_allclose(theirs.camera_to_world[:3, :3], ours.camera_to_world[:3, :3], atol=1e-9)
        np.testing.assert_allclose(theirs.intrinsics, ours.intrinsics)
        assert Path(theirs.image_path).read_bytes() == Path(ours.image_path).read_bytes()
    assert len(tables.tracks) == len(drive.tracks)
    by_place = {tuple(np.round(track.object_to_world[0, :3, 3] + shift, 4)): track for track in tables.tracks}
    for ours in drive.tracks:
        theirs = by_place[tuple(np.round(ours.object_to_world[0, :3, 3], 4))]
        assert (theirs.object_class, len(theirs.timestamps)) == (ours.object_class, len(ours.timestamps))
        np.testing.assert_allclose(theirs.size, ours.size)
    devkit = NuScenes(version=VERSION, dataroot=str(busy / TABLES), verbose=False)
    assert devkit.scene[0]["description"].startswith("Rendered by drivesplat, not recorded")
    attributes = {row["token"]: row["name"] for row in devkit.attribute}
    moving = [row for row in devkit.sample_annotation if row["category_name"] == "vehicle.car"]
    assert {attributes[token] for row in moving for token in row["attribute_tokens"]} == {"vehicle.moving"}


def test_boxes_of_the_devkit_lie_on_the_moved_car(busy, scene, model):
    """The hull of the box and the pixels that show the car alone, by intersection over union; the actor's Gaussians
    fill its box."""
    devkit = NuScenes(version=VERSION, dataroot=str(busy / TABLES), verbose=False)
    frames = {frame.timestamp: frame for frame in as_read(busy).frames}
    overlaps = []
    for sample in devkit.sample[:6]:
        row = devkit.get("sample_data", sample["data"]["CAM_FRONT"])
        _, boxes, intrinsics = devkit.get_sample_data(row["token"])
        nearest = min((box for box in boxes if box.name == "vehicle.car"), key=lambda box: box.center[2])
        pose = straight(scene.seconds(sample["timestamp"]) - 6.0 / SPEED) @ ASIDE
        placed = [ActorPlacement(AHEAD, pose, 1.0)]
        frame = frames[row["timestamp"]]
        full, empty = (shown_by(model, frame, scene, shown) for shown in (placed, []))
        shown = np.abs(full - empty).max(axis=-1) > 8
        if nearest.corners()[2].min() > 0.5 and shown.any():
            hull = hull_mask(view_points(nearest.corners(), intrinsics, True)[:2].T, (row["width"], row["height"]))
            overlaps.append((hull & shown).sum() / (hull | shown).sum())
    assert len(overlaps) >= 2
    assert np.median(overlaps) > 0.5


def hull_mask(corners: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    image = Image.new("1", size)
    ImageDraw.Draw(image).polygon([tuple(corner) for corner in corners[ConvexHull(corners).vertices]], fill=1)
    return np.asarray(image)


def with_side_camera(scene: Scene, ends: float) -> Scene:
    """A second camera that fires 40 ms after the first, until a second of the drive."""
    late = [
        dataclasses.replace(frame, camera="SIDE", timestamp=frame.timestamp + 40_000, token=f"side {frame.token}")
        for frame in scene.frames
        if scene.seconds(frame.timestamp) + 0.04 <= ends
    ]
    return dataclasses.replace(scene, frames=(*scene.frames, *late))


@pytest.mark.parametrize(
    ("ego", "ends", "counts"),
    [({"lateral": 1.0}, 9.0, (19, 19)), ({"speed": 2.0}, 9.0, (10, 9)), ({"speed": 2.0}, 2.1, (10, 4))],
    ids=["beside the path", "to the end of the path", "to the end of a camera's path"],
)
def test_every_camera_has_its_images_as_far_as_its_own_path_goes(ego, ends, counts, scene, model):
    rig = with_side_camera(scene, ends)
    job = a_job({"ego": ego}).model_copy(update={"cameras": ("CAM_FRONT", "SIDE")})
    drive = image_render_plan(rig, model, job, Path("here"), "it")
    found = [frame.camera for frame in drive.scene.frames]
    assert (found.count("CAM_FRONT"), found.count("SIDE")) == counts
    along = {(f.camera, f.timestamp): f.ego_to_world[0, 3] for f in drive.scene.frames}
    recorded = [frame.ego_to_world[0, 3] for frame in rig.frames]
    assert max(along.values()) < max(recorded) + 0.5, "no pose beyond the recorded path"


def test_a_trajectory_moves_camera_and_ego_vehicle_and_not_the_objects(scene, model, tmp_path):
    aside = TrajectorySettings(lateral=2.0, vertical=0.5)
    names = {"scene": "0001", "method": "street", "trajectory": "aside"}
    read_back = as_read(written(scene, model, tmp_path, a_job(trajectory=aside, width=None), names))
    assert read_back.frames[0].width == 32
    for frame, origin in zip(read_back.frames, scene.frames, strict=False):
        left, up = origin.ego_to_world[:3, 1], origin.ego_to_world[:3, 2]
        moved = frame.camera_to_world[:3, 3] - origin.camera_to_world[:3, 3]
        np.testing.assert_allclose(moved, 2.0 * left + 0.5 * up, atol=1e-9)
        np.testing.assert_allclose(frame.ego_to_world[:3, 3] - origin.ego_to_world[:3, 3], 2.0 * left, atol=1e-9)
    assert {track.id for track in read_back.tracks} == {AHEAD, TURNING, GONE}
    np.testing.assert_allclose(read_back.track(AHEAD).object_to_world, [straight(t) for t in KEY], atol=1e-6)


def test_a_disk_that_is_full_leaves_nothing_and_names_the_file(scene, model, tmp_path, monkeypatch):
    def full(path: Path, *_: Any) -> None:
        raise unwritable(path, "No space left on device")

    monkeypatch.setattr("drivesplat.editing.drive_folder.write_record", full)
    with pytest.raises(ResultError, match=r"drive\.json: cannot be written \(No space left on device\)"):
        written(scene, model, tmp_path, a_job({"ego": {"speed": 2.0}}, width=32))
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
