"""The labels of an exported drive: boxes of what its images show and of nothing else, as nuscenes-devkit reads them."""

import dataclasses
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.drives import LIDAR_AT
from helpers.hand_made import looking_at, motion_through, round_gaussians
from helpers.hand_made_street import AHEAD, DRIVERS, GONE, KEY, TURNING, checkpoint_of, straight, street_actors
from helpers.hand_made_street import street_model as model_of
from helpers.samples import sampled_with
from nuscenes.nuscenes import NuScenes
from nuscenes.scripts.export_2d_annotations_as_json import post_process_coords
from nuscenes.utils.geometry_utils import BoxVisibility, view_points

from drivesplat.editing.actors import other_objects, trained_actors
from drivesplat.editing.drive_folder import TABLES, VERSION, write_rendered_drive
from drivesplat.editing.film import track_labels
from drivesplat.editing.shown_objects import ShownObjects, parts_that_may_show
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.model.view import View
from drivesplat.readers.drive.format import read_drive
from drivesplat.rendering.frames import film_frame
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.export import DriveJob
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.render import TrajectorySettings
from drivesplat.trajectories.edited_actors import EditedActor

STEPS = [{"shift": {"track": AHEAD, "lateral": 2.0}}, {"remove": {"track": TURNING}}]
PARKED, WALKER, CONE = "vehicle.truck", "human.pedestrian.adult", "movable_object.trafficcone"
"""Annotated objects without Gaussians of their own; the other truck has some."""
SOURCE = {"scene": "0001", "method": "street"}


def the(category: str, scene: Scene) -> Track:
    return next(t for t in scene.tracks if t.category == category and t.id not in DRIVERS)


def boxful(track: Track, annotation: int = 0) -> np.ndarray:
    """World places (n, 3) that fill the upper three quarters of a box, 0.3 m apart."""
    half = track.size / 2 - 0.1
    low = np.array([-half[0], -half[1], -0.25 * track.size[2]])
    axes = [np.arange(a, b + 1e-9, 0.3) for a, b in zip(low, half, strict=True)]
    local = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    pose = track.object_to_world[annotation]
    return local @ pose[:3, :3].T + pose[:3, 3]


@pytest.fixture(scope="module")
def model(scene) -> SplatModel:
    """The background shows the parked truck, and the walker where it was first, and no cone."""
    places = np.concatenate([boxful(the(PARKED, scene)), boxful(the(WALKER, scene))])
    return model_of(round_gaussians(places, 0.15, colors=(0.9, 0.1, 0.1)), street_actors())


def exported(scene: Scene, model: SplatModel, folder: Path, *steps: dict[str, Any], until: int = 2) -> Path:
    job = DriveJob(
        eval_camera="CAM_FRONT",
        cameras=("CAM_FRONT",),
        images=ImageSettings(width=96),
        holdout=HoldoutSettings(every_nth=0, last_block=until),
        edit=Edit.model_validate({"steps": steps}) if steps else None,
        trajectory=None if steps else TrajectorySettings(),
    )
    name = {"edit": "it"} if steps else {"trajectory": "original"}
    path, cpu = folder / "drive.json", DeviceSettings(kind="cpu")
    write_rendered_drive(scene, checkpoint_of(model), job, cpu, path, {**SOURCE, **name}, {})
    return folder


@pytest.fixture(scope="module")
def folder(scene, model, tmp_path_factory) -> Path:
    return exported(scene, model, tmp_path_factory.mktemp("drive"), *STEPS)


@pytest.fixture(scope="module")
def devkit(folder) -> NuScenes:
    return NuScenes(version=VERSION, dataroot=str(folder / TABLES), verbose=False)


def test_boxes_are_of_objects_with_gaussians_and_of_parked_ones_that_the_background_shows(devkit, folder, scene):
    found = {row["instance_token"]: (row["category_name"], row["shown_by"]) for row in devkit.sample_annotation}
    assert Counter(found.values()) == {
        ("vehicle.car", "own"): 1, ("vehicle.truck", "own"): 1, ("vehicle.truck", "background"): 1
    }  # fmt: skip
    shown_by = read_drive(folder).rendered.shown_by
    assert shown_by == {
        AHEAD: "own", GONE: "own",
        the(PARKED, scene).id: "background", the(WALKER, scene).id: "none", the(CONE, scene).id: "none",
    }  # fmt: skip
    assert {track.id for track in read_drive(folder).tracks} == {k for k, v in shown_by.items() if v != "none"}


def test_every_box_in_an_image_has_an_object_of_the_model_in_it(devkit, scene, model):
    """Pixels change inside of the box when the Gaussians of its object are taken away."""
    assert len(devkit.image_annotations) > 10
    assert {row["shown_by"] for row in devkit.image_annotations} == {"own", "background"}
    bare = model_of(round_gaussians(boxful(the(WALKER, scene)), 0.15), street_actors())
    for row in devkit.image_annotations:
        image = devkit.get("sample_data", row["sample_data_token"])
        view = view_of(devkit, image, scene)
        left, top, right, bottom = (round(v) for v in row["bbox_corners"])
        if row["shown_by"] == "background":
            pair = [film_frame(m, view, sampled_with(m, view.time, [])) for m in (model, bare)]
        else:
            pose = straight(view.time)
            name = AHEAD if row["category_name"] == "vehicle.car" else GONE
            pose = None if name == GONE else pose + np.array([[0, 0, 0, 0], [0, 0, 0, 2.0], [0, 0, 0, 0], [0] * 4])
            shown = [ActorPlacement(name, pose)]
            pair = [film_frame(model, view, sampled_with(model, view.time, p)) for p in (shown, [])]
        changed = np.abs(np.subtract(*pair, dtype=int)).max(axis=2) > 8
        assert changed[top : bottom + 1, left : right + 1].any(), row


def view_of(devkit: NuScenes, image: dict[str, Any], scene: Scene) -> View:
    frame = next(f for f in scene.frames if f.timestamp == image["timestamp"])
    K = np.array(devkit.get("calibrated_sensor", image["calibrated_sensor_token"])["camera_intrinsic"])
    K[:2, 2] += 0.5
    pose = torch.from_numpy(frame.camera_to_world).float()
    return View(torch.from_numpy(K).float(), pose, image["width"], image["height"], scene.seconds(frame.timestamp))


def test_boxes_in_images_are_projected_as_the_devkit_projects_them(devkit):
    """The parked truck's, where it is before the camera: others are at the time of the image, not of the key frame."""
    compared = 0
    for row in devkit.image_annotations:
        tokens = [row["sample_annotation_token"]]
        _, found, K = devkit.get_sample_data(row["sample_data_token"], BoxVisibility.ANY, tokens)
        image, annotation = (
            devkit.get("sample_data", row["sample_data_token"]),
            devkit.get("sample_annotation", *tokens),
        )
        same = ("visibility_token", "num_lidar_pts", "category_name", "instance_token", "next", "prev", "shown_by")
        assert {key: row[key] for key in same} == {key: annotation[key] for key in same}
        assert row["filename"] == image["filename"]
        if row["shown_by"] == "background" and found and found[0].corners()[2].min() > 0.5:
            pixels = view_points(found[0].corners(), K, normalize=True)[:2].T + 0.5
            # the centre of the first pixel is at 0.5
            expected = post_process_coords(pixels.tolist(), (image["width"], image["height"]))
            if expected[2] < image["width"]:  # the devkit's box of a clipped hull is smaller than the clipped box
                np.testing.assert_allclose(row["bbox_corners"], expected, atol=0.05)
                compared += 1
    assert compared >= 3


def test_visibility_is_a_level_of_nuscenes_and_follows_what_hides_an_object():
    """A block seen whole, half behind a wall, and half outside of the image."""
    side = np.arange(-0.9, 0.95, 0.15)
    its = [[20.0 + x, y, z] for x in side for y in side for z in (-0.8, 0.0, 0.8)]
    motion = motion_through([0.0, 1.0], [[20.0, 0.0, 0.0]] * 2)
    block = EditedActor.recorded("block", ObjectClass.CAR, "vehicle.car", np.array([2.0, 2.0, 2.0]), motion)
    wall = [[10.0, y, z] for y in np.arange(-3.0, 0.0, 0.1) for z in np.arange(-2.0, 2.0, 0.1)]

    def visible(places: Any, view: View) -> list[float]:
        shown = ShownObjects(model_of(round_gaussians(places, 0.08)), [], [block], [frozenset({"background"})])
        return [item.visible for item in shown.seen_in(view)]

    ahead = looking_at([20.0, 0.0, 0.0], [0.0, 0.0, 0.0], width=480, height=320)
    assert visible(its, ahead) == pytest.approx([1.0], abs=0.01)
    assert visible([*its, *wall], ahead) == pytest.approx([0.5], abs=0.06)
    shifted = ahead.K.clone()
    shifted[0, 2] = 0.0
    assert visible(its, dataclasses.replace(ahead, K=shifted)) == pytest.approx([0.5], abs=0.03)
    assert visible(wall, ahead) == []


def test_annotations_say_how_visible_they_are(devkit):
    best: dict[str, float] = {}
    for row in devkit.image_annotations:
        best[row["sample_annotation_token"]] = row["visible_share"]
    levels = Counter()
    for row in devkit.sample_annotation:
        share = best.get(row["token"], 0.0)
        assert row["visibility_token"] == str(1 + sum(share >= edge for edge in (0.4, 0.6, 0.8)))
        assert devkit.get("visibility", row["visibility_token"])["level"].startswith("v")
        levels[row["visibility_token"]] += 1
    assert len(levels) > 1


def test_samples_and_images_beyond_the_training_are_marked(devkit):
    samples = sorted(devkit.sample, key=lambda row: row["timestamp"])
    assert [row["beyond_training"] for row in samples] == [False] * 8 + [True] * 2
    for row in devkit.sample_data:
        if row["is_key_frame"]:
            assert row["beyond_training"] is devkit.get("sample", row["sample_token"])["beyond_training"]


def test_lidar_points_are_those_of_the_recorded_box(devkit, scene):
    """Also of a car that the edit moves aside. By the files of the recording alone."""
    sweeps = sorted((s for s in scene.sweeps if s.is_key_frame), key=lambda s: s.timestamp)
    ego = {f.sample_index: f.ego_to_world for f in scene.frames if f.is_key_frame}
    parked = the(PARKED, scene)
    annotations = {
        (row["category_name"], row["shown_by"], index_of(devkit, row)): row for row in devkit.sample_annotation
    }
    total = 0
    for i, (sweep, seconds) in enumerate(zip(sweeps, KEY, strict=True)):
        points = np.fromfile(sweep.path, dtype=np.float32).reshape(-1, 5)[:, :3] + LIDAR_AT
        points = points + ego[i][:3, 3] + [4.0 * 0.035, 0.0, 0.0]  # the camera fires 35 ms before the LiDAR
        for key, pose, size in (
            (("vehicle.car", "own"), straight(seconds), np.array(DRIVERS[AHEAD].size)),
            (("vehicle.truck", "background"), parked.object_to_world[0], parked.size),
        ):
            local = points @ inverse(pose)[:3, :3].T + inverse(pose)[:3, 3]
            inside = int((np.abs(local) < size / 2).all(axis=1).sum())
            assert abs(annotations[(*key, i)]["num_lidar_pts"] - inside) <= 1, "float32 at the surface"
            total += inside
    assert total > 20


def index_of(devkit: NuScenes, row: dict[str, Any]) -> int:
    times = sorted(sample["timestamp"] for sample in devkit.sample)
    return times.index(devkit.get("sample", row["sample_token"])["timestamp"])


def test_a_model_without_actors_has_boxes_of_parked_objects_alone_and_warns(scene, tmp_path, caplog):
    places = [*boxful(the(PARKED, scene)), *(straight(2.0)[:3, 3] + np.random.default_rng(0).normal(size=(50, 3)))]
    rare = dataclasses.replace(scene, frames=tuple(frame for frame in scene.frames if frame.is_key_frame))
    exported(rare, model_of(round_gaussians(places, 0.15)), tmp_path, until=3)
    devkit = NuScenes(version=VERSION, dataroot=str(tmp_path / TABLES), verbose=False)
    assert {(row["category_name"], row["shown_by"]) for row in devkit.sample_annotation} == {
        ("vehicle.truck", "background")
    }
    assert "moving objects without Gaussians of their own in this model: 4" in caplog.text


def test_labels_of_a_film_name_a_source_only_of_what_has_gaussians_of_its_own(scene, model):
    seconds = 0.5 * np.arange(9)
    actors, frames = trained_actors(model, scene, "here"), [f for f in scene.frames if f.is_key_frame]
    objects = ShownObjects.of_scene(scene, model, actors, other_objects(scene, actors))
    image = {"width": 96, "height": 54}
    K = torch.tensor([[60.0, 0.0, 48.0], [0.0, 60.0, 27.0], [0.0, 0.0, 1.0]])
    poses = [torch.from_numpy(frame.camera_to_world).float() for frame in frames[:9]]
    views = [View(K, pose, **image, time=at) for pose, at in zip(poses, seconds.tolist(), strict=True)]
    labels = {item["id"]: (item["source"], item["shown_by"]) for item in track_labels(objects, seconds, views)}
    assert labels == {
        **{name: (name, "own") for name in (AHEAD, TURNING, GONE)},
        the(PARKED, scene).id: (None, "background"),
        **{the(category, scene).id: (None, "none") for category in (WALKER, CONE)},
    }


@pytest.mark.parametrize(
    ("places", "size", "parts"),
    [
        ([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.1, 0.2, 0.0]], (4.5, 1.8, 1.5), {"background"}),
        ([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0]], (4.5, 1.8, 1.5), {"background"}),
        ([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], (0.7, 0.7, 1.8), set()),
        ([[0.0, 0.0, 0.0], [8.0, 0.0, 0.0], [8.0, 0.0, 0.0]], (4.5, 1.8, 1.5), set()),
    ],
    ids=["jitter of an annotation", "a fifth of its length", "more than its length", "it stands only later"],
)
def test_a_background_shows_what_stays_in_its_place(places, size, parts, scene):
    poses = np.stack([np.eye(4)] * len(places))
    poses[:, :3, 3] = places
    n = np.arange(len(places))
    track = dataclasses.replace(
        the(PARKED, scene), size=np.array(size), object_to_world=poses, timestamps=n, sample_indices=n, visibility=n
    )
    model = model_of(round_gaussians([[5.0, 0.0, 0.0]]), street_actors())
    assert parts_that_may_show(track, model) == parts
