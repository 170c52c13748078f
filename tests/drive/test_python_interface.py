"""`drivesplat.open` and what it gives, on a finished workflow."""

import dataclasses
import re
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import REPOSITORY
from helpers.shared_runs import CAR

import drivesplat
from drivesplat.drive.trained_drive import TrainedDrive
from drivesplat.drive.world_state import WorldState
from drivesplat.editing.film import edited_frames, edited_shots
from drivesplat.errors import ConfigError, DriveSplatError, RequestError, ResultError
from drivesplat.model.checkpoint import read_checkpoint, write_checkpoint
from drivesplat.rendering.film import recorded_shot
from drivesplat.scene.scene import read_scene, write_scene
from drivesplat.settings.edit import Edit
from drivesplat.settings.render import EditJob
from drivesplat.settings.tracks import FOUND

pytestmark = pytest.mark.workflow
CAMERA, TIME = "CAM_FRONT", 1.0
STOP = [{"stop": {"track": CAR, "at": 1.0}}]
SMALL = {"camera": CAMERA, "width": 64, "height": 36, "fps": 4, "crf": 20, "horizontal_fov": None}
AHEAD = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
"""World axes to the axes of a camera that looks along x."""


@pytest.fixture(scope="module")
def street(finished_run) -> Path:
    return finished_run.folder / "results/0001/street"


@pytest.fixture(scope="module")
def drive(street) -> TrainedDrive:
    return drivesplat.open(street, device="cpu")


@pytest.fixture
def world(drive) -> WorldState:
    return drive.state(TIME)


def shots(drive: TrainedDrive, steps: list):
    job = EditJob.model_validate({**SMALL, "edit": {"steps": steps}})
    return edited_shots(drive.scene, drive.model, job, "a test")


def camera_of(shot) -> "drivesplat.Camera":
    return drivesplat.Camera(*shot.size, shot.K)


# ---- what a drive knows


def test_the_table_of_objects_says_what_can_be_edited_and_why_not(drive):
    table = drive.actors
    car = table.loc[CAR]
    assert car["editable"] and car["why_not"] == "" and car["class"] == "car" and car["speed"] > 1.0
    assert 0.0 <= car["first"] < car["last"] <= drive.duration + 0.1
    others = table[~table["editable"]]
    assert len(others) and (others["why_not"] != "").all() and table.index.is_unique


def test_a_recorded_camera_has_the_intrinsics_and_the_mount_of_its_images(drive):
    camera = drive.camera(CAMERA)
    index = next(i for i, frame in enumerate(drive.scene.frames) if frame.camera == CAMERA)
    frame = drive.scene.frames[index]
    assert (camera.width, camera.height) == drive.record.image_size(index)
    np.testing.assert_allclose(camera.K, drive.record.Ks[index], rtol=1e-6)
    seconds = drive.scene.seconds(frame.timestamp)
    np.testing.assert_allclose(drive.camera_to_world(CAMERA, seconds), frame.camera_to_world, atol=1e-9)
    np.testing.assert_allclose(drive.ego_to_world(seconds) @ camera.camera_to_ego, frame.camera_to_world, atol=1e-9)


def test_importing_the_package_imports_nothing_heavy():
    code = "import drivesplat, sys; print(sorted({'torch', 'numpy', 'pandas', 'snakemake'} & set(sys.modules)))"
    found = subprocess.run([sys.executable, "-c", code], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert found.stdout == "[]\n"


# ---- renderings


def test_images_are_those_of_films_byte_for_byte(drive):
    shot = shots(drive, STOP).before
    frames = list(recorded_shot(drive.model, shot, torch.device("cpu")))
    for number in (0, len(frames) // 2):
        found = drive.render(
            camera_of(shot), shot.seconds[number], camera_to_world=shot.cameras.camera_to_world[number]
        )
        np.testing.assert_array_equal(found.image, frames[number])
        np.testing.assert_allclose(
            drive.camera_to_world(CAMERA, shot.seconds[number]), shot.cameras.camera_to_world[number], atol=1e-9
        )


def test_images_after_an_edit_are_those_of_its_film_byte_for_byte(drive):
    steps = [*STOP, {"ego": {"speed": 0.5}}]
    found = shots(drive, steps)
    shot, cpu = found.after, torch.device("cpu")
    frames = list(edited_frames(drive.model, shot.views(cpu), found.actors, np.array(shot.seconds)))
    edited, last = drive.edited(steps), len(frames) - 1
    pose = shot.cameras.camera_to_world[last]
    assert np.linalg.norm(pose[:3, 3] - drive.camera_to_world(CAMERA, shot.seconds[last])[:3, 3]) > 0.5
    np.testing.assert_allclose(edited.camera_to_world(CAMERA, shot.seconds[last]), pose, atol=1e-9)
    image = edited.render(camera_of(shot), shot.seconds[last], camera_to_world=pose).image
    np.testing.assert_array_equal(image, frames[last])
    assert not np.array_equal(image, drive.render(camera_of(shot), shot.seconds[last], camera_to_world=pose).image)
    assert drive.edited(Edit.model_validate({"steps": steps})).edit == edited.edit


def test_outputs_are_those_that_are_asked_for(drive):
    every = drive.render(CAMERA, TIME, outputs=["rgb", "depth", "alpha", "instance", "boxes"])
    alone = drive.render(CAMERA, TIME)
    assert torch.equal(alone.rgb, every.rgb) and alone.depth is alone.alpha is alone.instance is alone.boxes is None
    arrays = every.arrays()
    height, width = arrays["depth"].shape
    assert {name: values.shape for name, values in arrays.items()} == {
        "rgb": (height, width, 3), "depth": (height, width), "alpha": (height, width), "instance": (height, width)
    }  # fmt: skip
    assert every.objects == (CAR,) and {box.id for box in every.boxes} <= set(drive.actors.index)
    assert drive.render(CAMERA, TIME, outputs=["depth"]).rgb is None


def test_an_objects_pixels_and_depths_are_where_it_stands(drive, world):
    """A car 8 m ahead of a camera of one's own."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = AHEAD[:3, :3].T, [0.0, 0.0, 30.0]
    there = np.eye(4)
    there[:3, 3] = [8.0, 0.0, 30.0]
    world.actors[CAR].pose = there
    camera = drivesplat.Camera.from_fov(64, 48, 90.0)
    view = world.render(camera, camera_to_world=pose, outputs=["instance", "depth", "boxes"])
    shown = view.instance == 0
    assert shown[24, 32] and not shown[0].any() and 4 < int(shown.sum()) < 32 * 48
    length = float(world.actors[CAR].size[0])
    assert ((view.depth[shown] > 8.0 - length) & (view.depth[shown] < 8.0 + length)).float().mean() > 0.9
    (box,) = view.boxes
    left, top, right, bottom = box.box_2d
    assert box.id == CAR and left < 32 < right and top < 24 < bottom and box.visible_share > 0.9
    np.testing.assert_array_equal(box.object_to_world, there)
    alpha = world.render(camera, camera_to_world=pose, outputs=["alpha"]).alpha
    assert (alpha[shown] > 0.45).all(), "the sky shows more than the object does elsewhere"


# ---- states


def test_a_moved_object_leaves_all_others_alone(drive, world):
    recorded = drive.render(CAMERA, TIME, outputs=["rgb", "instance"])
    beside = world.actors[CAR].pose
    beside[:3, 3] += 2.0 * beside[:3, 1]
    world.add(CAR, "twin", beside)
    view = world.render(CAMERA, outputs=["rgb", "instance"])
    assert view.objects == (CAR, "twin") and (view.instance == 1).any()
    kept = (recorded.instance == 0) & (view.instance != 1)
    assert kept.any() and (view.instance[kept] == 0).float().mean() > 0.95
    assert world.actors.get("twin") is world.actors["twi"] and world.actors.get("nobody") is None
    world.remove("twin")
    again = world.render(CAMERA)
    torch.testing.assert_close(again.rgb, recorded.rgb, atol=1e-5, rtol=0)


def test_an_object_at_its_own_pose_changes_nothing_and_a_removed_one_is_gone(drive, world):
    recorded = drive.render(CAMERA, TIME, outputs=["rgb", "instance"])
    world.actors["0001 inst"].pose = world.actors[CAR].pose
    torch.testing.assert_close(world.render(CAMERA).rgb, recorded.rgb, atol=1e-4, rtol=0)
    world.remove(CAR)
    gone = world.render(CAMERA, outputs=["rgb", "instance", "boxes"])
    assert not len(world.actors) and (gone.instance == -1).all() and CAR not in {box.id for box in gone.boxes}
    changed = (gone.rgb - recorded.rgb).abs().amax(dim=2) > 0.02
    assert changed[recorded.instance == 0].float().mean() > 0.2
    assert (drive.render(CAMERA, TIME).rgb == recorded.rgb).all(), "the drive is as it was"


def test_a_time_outside_is_clamped_where_asked_to(drive):
    assert drive.state(1e3, outside="clamp").time == drive.duration and drive.state(-1.0, outside="clamp").time == 0.0


def test_cameras_of_ones_own_keep_their_field_of_view(drive):
    camera = drivesplat.Camera.from_fov(100, 50, 90.0, camera_to_ego=drive.camera(CAMERA).camera_to_ego)
    half = camera.resized(50)
    assert (half.width, half.height, half.K[0, 0], half.K[1, 2]) == pytest.approx((50, 25, 25.0, 12.5))
    own = drive.render(half, TIME, ego_to_world=drive.ego_to_world(TIME)).rgb
    torch.testing.assert_close(own, drive.render(half, TIME).rgb, atol=1e-5, rtol=0)


# ---- errors

SKEWED, NO_POSE = np.diag([1.0, 1.0, 1.5, 1.0]), np.full((4, 4), np.nan)


@pytest.mark.parametrize(
    ("call", "error", "words"),
    [
        (lambda drive, _: drive.render("CAM_X", TIME), RequestError, ["CAM_X", CAMERA]),
        (lambda drive, _: drive.render(CAMERA, 99.0), RequestError, ["99", "clamp"]),
        (lambda drive, _: drive.render(CAMERA, float("nan")), RequestError, ["nan"]),
        (lambda drive, _: drive.render(CAMERA, TIME, outputs=["normals"]), RequestError, ["normals", "depth"]),
        (lambda drive, _: drive.render(CAMERA, TIME, camera_to_world=NO_POSE), RequestError, ["the camera"]),
        (lambda drive, _: drive.render(CAMERA, TIME, ego_to_world=SKEWED), RequestError, ["ego vehicle", "rigid"]),
        (lambda drive, _: drive.view(CAMERA, TIME, np.eye(4), np.eye(4)), RequestError, ["one pose"]),
        (lambda drive, _: drive.render(drivesplat.Camera.from_fov(8, 8, 90.0), TIME), RequestError, ["camera_to_ego"]),
        (lambda drive, world: world.actors["zz"], RequestError, ["zz", CAR]),
        (lambda drive, world: world.actors[""], RequestError, [CAR]),
        (lambda drive, world: world.remove("zz"), RequestError, ["zz"]),
        (lambda drive, world: world.add(CAR, CAR, np.eye(4)), RequestError, [CAR]),
        (lambda drive, world: setattr(world.actors[CAR], "pose", torch.zeros(3, 3)), RequestError, [CAR]),
        (lambda drive, _: drive.edited([{"remove": {"trak": CAR}}]), ConfigError, ["step 1", "trak"]),
        (lambda drive, _: drive.edited(STOP).edited(STOP), RequestError, ["already"]),
        (lambda drive, _: drive.edited([{"ego": {"speed": 0.5, "start": 99.0}}]), ConfigError, ["start"]),
        (lambda drive, _: drive.edited([{"ego": {"speed": 3.0}}]).ego_to_world(4.0), RequestError, ["path"]),
        (lambda drive, _: drive.camera_to_world(CAMERA, 99.0), RequestError, ["99"]),
        (lambda drive, _: drive.state(1.0, outside="error"), RequestError, ["clamp"]),
        (lambda drive, _: drivesplat.open(drive.folder, "gpu"), RequestError, ["gpu", "cuda"]),
        (lambda drive, _: drive.render(CAMERA, TIME, outputs=["depth"]).image, RequestError, ["rgb"]),
        (lambda drive, world: world.add(CAR, "0001 instance 1", np.eye(4)), RequestError, ["0001 instance 1"]),
        (lambda drive, world: world.add(CAR, "", np.eye(4)), RequestError, ["name"]),
        (lambda drive, _: drive.view(CAMERA, TIME, None, [[1.0], [2.0, 3.0]]), RequestError, ["the camera"]),
        (lambda drive, _: drive.edited([]), ConfigError, ["steps"]),
        (lambda drive, _: drive.edited([{"remove": {"track": "zz"}}]), ConfigError, ["zz", "step 1"]),
        (lambda drive, _: drivesplat.Camera(0, 8, np.eye(3)), RequestError, ["0x8"]),
        (lambda drive, _: drivesplat.Camera(8, 8, np.zeros((3, 3))), RequestError, ["camera"]),
        (lambda drive, _: drivesplat.Camera.from_fov(8, 8, 180.0), RequestError, ["180"]),
    ],
)  # fmt: skip
def test_what_a_drive_cannot_give_is_one_sentence(call, error, words, drive, world):
    with pytest.raises(error) as raised:
        call(drive, world)
    assert all(word in str(raised.value) for word in words), raised.value
    assert isinstance(raised.value, DriveSplatError) and "\n" not in str(raised.value)


def test_folders_without_a_training_and_foreign_files_are_named(tmp_path, street):
    with pytest.raises(RequestError, match=r"checkpoint\.npz"):
        drivesplat.open(tmp_path)
    (tmp_path / "street").mkdir()
    (tmp_path / "street/checkpoint.npz").write_bytes((street / "checkpoint.npz").read_bytes())
    with pytest.raises(ResultError, match=r"scene\.json"):
        drivesplat.open(tmp_path / "street")
    with pytest.raises(AttributeError):
        _ = drivesplat.nothing


def test_methods_without_labels_open_with_their_own_files(tmp_path, street):
    """Discovered tracks have a scene of their own; a method without tracks may have no other training record."""
    checkpoint, scene = read_checkpoint(street / "checkpoint.npz"), read_scene(street.parent / "scene.json")
    found = FOUND + CAR

    def renamed(of: Sequence) -> list:
        return [dataclasses.replace(item, id=found) if item.id == CAR else item for item in of]

    parts = [dataclasses.replace(part, tracks=tuple(renamed(part.tracks))) for part in checkpoint.parts]
    for folder in ("mine", "blind", "discovered", "unlabelled"):
        (tmp_path / folder).mkdir()
    write_checkpoint(tmp_path / "mine/checkpoint.npz", dataclasses.replace(checkpoint, parts=parts))
    write_scene(tmp_path / "discovered/scene.json", dataclasses.replace(scene, tracks=tuple(renamed(scene.tracks))))
    shutil.copy(street.parent / "parser.npz", tmp_path / "discovered")
    assert list(drivesplat.open(tmp_path / "mine", "cpu").state(TIME).actors) == [found]
    shutil.copy(street.parent / "vanilla/checkpoint.npz", tmp_path / "blind")
    shutil.copy(street.parent / "scene.json", tmp_path)
    shutil.copy(street.parent / "parser.npz", tmp_path / "unlabelled")
    blind = drivesplat.open(tmp_path / "blind", "cpu")
    view = blind.render(CAMERA, TIME, outputs=["rgb", "instance"])
    assert not view.objects and (view.instance == -1).all() and not blind.actors["editable"].any()


# ---- the guide


def test_the_examples_of_the_guide_run(street, tmp_path, monkeypatch):
    (tmp_path / "results").mkdir()
    (tmp_path / "results/demo").symlink_to(street.parent)
    monkeypatch.chdir(tmp_path)
    examples = re.findall(r"```python\n(.*?)```", (REPOSITORY / "docs/python.md").read_text(), flags=re.DOTALL)
    names: dict = {}
    for example in examples:
        exec(example, names)
    assert len(examples) >= 5 and names["after"].image.shape == names["view"].image.shape
