"""Damaged NCore clips, those of other versions and missing packages are refused in one sentence."""

import builtins
import json
import shutil
import sys
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from helpers import drives
from helpers.drives import START_US, World, turning_world, uncompared
from helpers.mutations import JUNK, damages, flip_bytes, fresh, mutate_bytes, mutate_json, mutate_text
from helpers.ncore_clips import NAME, PLACE, turning_recording, write_clip, write_metadata
from helpers.table_files import time_limit

from drivesplat.errors import DatasetError
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.datasets import missing_package
from drivesplat.readers.ncore.layout import camera_names, find_root, outline, table_files
from drivesplat.readers.ncore.reader import read
from drivesplat.readers.ncore.store_metadata import METADATA, store_metadata
from drivesplat.readers.ncore.unpack import unpack
from drivesplat.readers.sweeps import read_returns, read_scan, sweep_fault
from drivesplat.scene.scene import Scene
from drivesplat.settings.extract import SceneSource

pytest.importorskip("ncore")
pytestmark = [
    pytest.mark.usefixtures("uncompared"),
    pytest.mark.filterwarnings("ignore:.NoneType. object value of non-optional type:RuntimeWarning"),  # of the library
]


def source(**changes: Any) -> SceneSource:
    given = {"dataset": "mine", "reader": "ncore", "version": "", "scene": NAME, "cameras": ("front",)}
    return drives.source(**{**given, "sweeps": True, "lidar_sweeps": True, **changes})


def extracted(root: Path, folder: Path, **changes: Any) -> Scene:
    with time_limit(), uncompared():
        return extract_scene(source(**changes), root, None, folder)


@pytest.fixture(scope="module", autouse=True)
def unsynchronised():
    """Files are not forced to the disk, which takes most of the time of small clips."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("os.fsync", lambda _: None)
        yield


def small_world() -> World:
    world = turning_world(PLACE)
    world.width, world.height = 24, 16
    return world


@pytest.fixture(scope="module")
def roots(tmp_path_factory) -> dict[str, Path]:
    recording, _ = turning_recording(small_world(), START_US, sweeps=2, rays=(4, 30))
    recording.times, recording.rig_to_global = recording.times[::5], recording.rig_to_global[::5]
    recording.boxes = [box for box in recording.boxes if box[0] == "car"]
    return {
        store: write_clip(tmp_path_factory.mktemp(store), recording, store=store) for store in ("itar", "directory")
    }


def store_in(root: Path) -> Path:
    return next(root.glob("*.ncore4.zarr*"))


def changed(roots: dict[str, Path], folder: Path, change: Callable[[dict], object]) -> Path:
    """A copy of the clip whose metadata `change` has changed."""
    root = Path(shutil.copytree(roots["directory"], folder / "clip"))
    metadata = deepcopy(store_metadata(store_in(root)))
    change(metadata)
    write_metadata(store_in(root) / METADATA, metadata)
    return root


def refusal(root: Path, folder: Path, **changes: Any) -> str:
    with pytest.raises(DatasetError) as caught:
        extracted(root, folder, **changes)
    one_line(caught.value, root)
    return str(caught.value)


def one_line(error: DatasetError, done: object) -> None:
    message = str(error)
    assert "\n" not in message and 10 < len(message) < 1000 and message.isprintable(), (done, message)


# What is missing


def test_a_missing_package_is_named_with_what_installs_it(roots, tmp_path, monkeypatch):
    imported = builtins.__import__

    def without(missing: str) -> Callable:
        def importing(name: str, *args: Any) -> Any:
            if name.partition(".")[0] == missing:
                raise ImportError(f"No module named {missing!r}", name=missing)
            return imported(name, *args)

        return importing

    for module in [name for name in sys.modules if name.partition(".")[0] in ("ncore", "cbor2")]:
        monkeypatch.delitem(sys.modules, module)
    for missing in ("ncore", "cbor2"):
        monkeypatch.setattr(builtins, "__import__", without(missing))
        message = refusal(roots["itar"], tmp_path)
        assert "pip install 'drivesplat[ncore]'" in message and missing in message
    assert outline(roots["itar"], "", NAME) is None, "planning leaves the sentence to extract"
    assert camera_names(roots["itar"], "") == ["front"], "manifests are JSON"


def test_the_doctor_names_a_missing_package(monkeypatch):
    assert missing_package("ncore") is None
    monkeypatch.setattr("drivesplat.readers.ncore.layout.find_spec", lambda name: None if name == "zarr" else name)
    assert (
        missing_package("ncore") == "zarr, which reads NCore clips, is not installed: pip install 'drivesplat[ncore]'"
    )


def test_no_clips_and_unknown_scenes_are_refused(roots, tmp_path):
    with pytest.raises(DatasetError, match=r"there is no folder .*nowhere; docs/ncore\.md says"):
        find_root(str(tmp_path / "nowhere"), "")
    with pytest.raises(DatasetError, match=r"looked for \*\.ncore4\*\.zarr\.itar in"):
        find_root(str(tmp_path), "")
    for name in ("a", "ab"):
        shutil.copytree(roots["itar"], tmp_path / name)
        for file in (tmp_path / name).iterdir():
            file.rename(file.with_name(file.name.replace(NAME, f"clip_{name}")))
        (tmp_path / name / f"clip_{name}.json").unlink()
    with pytest.raises(DatasetError, match=r"scene other is not there; in .* there are: clip_a, clip_ab$"):
        table_files(tmp_path, "", "other")
    with pytest.raises(DatasetError, match=r"scene clip begins the names of several clips; .*: clip_a, clip_ab$"):
        table_files(tmp_path, "", "clip")
    assert len(table_files(tmp_path, "", "clip_a")) == 1, "a whole name is not a beginning"


def test_a_missing_store_is_named(roots, tmp_path):
    root = Path(shutil.copytree(roots["itar"], tmp_path / "clip"))
    content = json.loads((root / f"{NAME}.json").read_text())
    content["component_stores"].append({"path": f"{NAME}.ncore4-rear.zarr.itar", "md5": "", "components": {}})
    (root / f"{NAME}.json").write_text(json.dumps(content))
    assert "ncore4-rear.zarr.itar is missing; copy the whole clip again" in refusal(root, tmp_path)
    root = Path(shutil.copytree(roots["directory"], tmp_path / "unfinished"))
    (store_in(root) / METADATA).unlink()
    assert f"has no {METADATA}; copy the whole clip again" in refusal(root, tmp_path)


def test_a_store_whose_name_cannot_be_printed_is_refused(roots, tmp_path):
    root = Path(shutil.copytree(roots["itar"], tmp_path / "clip"))
    content = json.loads((root / f"{NAME}.json").read_text())
    content["component_stores"][0]["path"] = "\ud800"
    (root / f"{NAME}.json").write_text(json.dumps(content))
    assert "must be stores beside it" in refusal(root, tmp_path)


def test_other_versions_are_refused(roots, tmp_path):
    root = Path(shutil.copytree(roots["itar"], tmp_path / "manifest"))
    content = json.loads((root / f"{NAME}.json").read_text())
    (root / f"{NAME}.json").write_text(json.dumps({**content, "version": "v5"}))
    assert "is a clip of NCore version 'v5', and v4 is read" in refusal(root, tmp_path)
    root = Path(shutil.copytree(roots["itar"], tmp_path / "store"))
    (root / f"{NAME}.json").unlink()
    store_in(root).rename(root / f"{NAME}.ncore5.zarr.itar")
    assert "is a store of NCore V5, and V4 is read" in refusal(root, tmp_path)

    def newer(component: str) -> Callable[[dict], object]:
        return lambda metadata: metadata[f"{component}/.zattrs"].update(component_version="v2")

    for component in ("cameras/front", "lidars/lidar", "poses/default", "cuboids/default"):
        root = changed(roots, tmp_path / component, newer(component))
        assert f"its component {component} is of version 'v2', and v1 is read" in refusal(root, tmp_path)
    root = changed(roots, tmp_path / "root", lambda metadata: metadata[".zattrs"].update(version="v9"))
    assert f"clip {NAME} cannot be read (RuntimeError: Can't load V4 component store" in refusal(root, tmp_path)


def test_unknown_cameras_and_frame_ranges_are_refused(roots, tmp_path):
    assert "has no camera 'rear'; there are: front" in refusal(roots["itar"], tmp_path, cameras=("rear",))
    assert "ends beyond its 2 key frames" in refusal(roots["itar"], tmp_path, frames=(0, 9))


# Single faults

POSE = "poses/default/dynamic_poses/.zattrs"
STATIC = "poses/default/static_poses/.zattrs"
CAMERA = "intrinsics/default/cameras/front/.zattrs"
BOXES = "cuboids/default/cuboids/.zattrs"
FAULTS: dict[str, tuple[Callable[[dict], object], str]] = {
    "a pose that scales": (
        lambda it: it[POSE]["('rig', 'world')"]["poses"][3][0].__setitem__(0, 3.0), "its transform is not rigid",
    ),
    "times out of order": (
        lambda it: it[POSE]["('rig', 'world')"]["timestamps_us"].__setitem__(2, START_US), "is not later than that",
    ),
    "no rig": (lambda it: it.update({POSE: {}}), "no poses connect 'rig' with 'world'"),
    "no mount": (
        lambda it: it[STATIC].pop("('front', 'rig')"), "its poses have no frame of reference 'front'; there are",
    ),
    "a mount far away": (
        lambda it: it[STATIC]["('lidar', 'rig')"]["pose"][0].__setitem__(3, 5000.0), "LiDAR lidar: its translation",
    ),
    "a pair that is none": (
        lambda it: it[STATIC].update({"'rig'": it[STATIC]["('front', 'rig')"]}), "must name two frames of reference",
    ),
    "no intrinsics": (lambda it: it.pop(CAMERA), "camera front: its model cannot be read (KeyError"),
    "an unknown lens": (
        lambda it: it[CAMERA].update(camera_model_type="omni"), "Unknown camera model type: omni",
    ),
    "a focal length in metres": (
        lambda it: it[CAMERA]["camera_model_parameters"].update(focal_length=[0.004, 0.004]), "its focal length is",
    ),
    "a flat box": (
        lambda it: it[BOXES]["cuboid_track_observations"][0]["bbox3"].update(dim=[4.0, 0.0, 1.0]),
        "cuboid car: its size is",
    ),
    "a box in a frame that is not there": (
        lambda it: it[BOXES]["cuboid_track_observations"][0].update(reference_frame_id="radar"),
        "no frame of reference 'radar'",
    ),
    "frames that end before they start": (
        lambda it: it["cameras/front/frames/.zattrs"]["frames_timestamps_us"][0].reverse(),
        "must be pairs of whole microseconds",
    ),
    "nanoseconds": (
        lambda it: it["lidars/lidar/frames/.zattrs"].update(frames_timestamps_us=[[10**18, 10**18 + 1]]),
        "must be pairs of whole microseconds",
    ),
    "no component": (
        lambda it: [it.pop(key) for key in list(it) if key.startswith("poses/")], "its component poses is missing",
    ),
    "an array of a billion values": (
        lambda it: [
            it[key].update(shape=[10**9, 3]) for key in it if key.endswith("ray_bundle/direction/.zarray")
        ],
        "has no possible size",
    ),
    "arrays of different lengths": (
        lambda it: [it[key].update(shape=[7, 3]) for key in it if key.endswith("ray_bundle/direction/.zarray")],
        "its arrays have different numbers of rays",
    ),
    "no path": (
        lambda it: it[POSE]["('rig', 'world')"].update(
            poses=it[POSE]["('rig', 'world')"]["poses"][:2],
            timestamps_us=[START_US, START_US + 1],
        ),
        "no image and no sweep of the clip is recorded on the path of its rig",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_faults_of_values_are_named(name, roots, tmp_path):
    change, expected = FAULTS[name]
    assert expected in refusal(changed(roots, tmp_path, change), tmp_path / "out")


def test_an_image_that_is_not_there_is_named_or_left_out(roots, tmp_path):
    frames = extracted(roots["itar"], tmp_path / "whole").frames
    key = f"cameras/front/frames/{frames[1].token.removeprefix('front/')}/image/.zarray"
    root = changed(roots, tmp_path, lambda metadata: metadata.pop(key))
    assert f"image {frames[1].token} is not in the clip" in refusal(root, tmp_path / "out")
    scene = extracted(root, tmp_path / "out", on_missing="warn")
    assert scene.missing_images == 1 and len(scene.frames) == len(frames) - 1


# 200 damaged clips


def require_sound(scene: Scene, folder: Path) -> None:
    """What the checks of readers promise, computed in other ways than they do."""
    times = scene.key_frame_timestamps
    assert len(times) and (np.diff(times) > 0).all() and times[0] >= 0 and times[-1] <= 1e17
    poses = [pose for frame in scene.frames for pose in (frame.camera_to_world, frame.ego_to_world)]
    poses += [sweep.sensor_to_world for sweep in scene.sweeps]
    poses += [pose for track in scene.tracks for pose in track.object_to_world]
    assert np.isfinite(poses).all() and np.abs(poses).max() <= 3e8
    turns = np.array(poses)[:, :3, :3]
    np.testing.assert_allclose(turns @ np.swapaxes(turns, 1, 2), np.eye(3)[None].repeat(len(turns), 0), atol=1e-6)
    for frame in scene.frames:
        assert folder in Path(frame.image_path).parents and ".." not in Path(frame.image_path).parts
        assert frame.camera_velocity is None or np.isfinite(frame.camera_velocity).all()
    for track in scene.tracks:
        assert ((track.size > 0) & (track.size <= 1000)).all() and (np.diff(track.timestamps) > 0).all()
    for sweep in scene.sweeps:
        assert folder in Path(sweep.path).parents
        if not Path(sweep.path).is_absolute():
            continue
        if fault := sweep_fault(sweep):
            assert "\n" not in fault and fault.isprintable()
            continue
        assert np.isfinite(read_returns(sweep).points).all()
        scan = read_scan(sweep, None)
        assert scan is None or (np.isfinite(scan.rays.offsets_s).all() and np.isfinite(scan.ranges).all())


def sound_or_refused(root: Path, folder: Path, done: object, unpacked: bool = True) -> bool:
    """Plans, reads and, unless asked otherwise, unpacks a clip; whether it was refused."""
    try:
        with time_limit():
            find_root(str(root), "")
            table_files(root, "", NAME)
            camera_names(root, "")
            outline(root, "", NAME)
            scene = read(root, source(), None)
            if unpacked:
                scene = unpack(scene, root, source(), folder)
    except DatasetError as error:
        one_line(error, done)
        return True
    require_sound(scene, folder if unpacked else Path())
    return False


def test_undamaged_clips_are_read(roots, tmp_path):
    for store, root in roots.items():
        assert not sound_or_refused(root, tmp_path / store, "nothing")


@damages(35, 300)
def test_damaged_bytes(roots, tmp_path, random: Random):
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(roots["itar"], folder / "clip"))
        store = store_in(root)
        if random.randrange(3):
            done = mutate_bytes(random, store)
        else:  # the index and the metadata lie at the end
            whole = store.read_bytes()
            (folder / "end").write_bytes(whole[-8000:])
            flip_bytes(random, folder / "end")
            store.write_bytes(whole[:-8000] + (folder / "end").read_bytes())
            done = "the end"
        sound_or_refused(root, folder / "out", done)


@damages(25, 600)
def test_damaged_metadata(roots, tmp_path, random: Random):
    with fresh(tmp_path) as folder:
        root = folder / "clip"
        root.mkdir()
        for file in roots["directory"].iterdir():
            (root / file.name).symlink_to(file)
        store = store_in(root)
        metadata = store_metadata(store)
        key = random.choice([key for key in metadata if not key.endswith(".zgroup")])
        damaged = {**metadata, key: mutate_json(random, metadata[key])} if metadata[key] else {}
        try:
            relinked(store, damaged)
        except (OverflowError, UnicodeError, ValueError):
            return  # a value that no store can hold
        sound_or_refused(root, folder / "out", key, unpacked=key.startswith(("cameras/", "lidars/")))


def relinked(store: Path, metadata: dict) -> None:
    """A folder of links to a store, with other metadata."""
    target = store.resolve()
    store.unlink()
    store.mkdir()
    for file in target.iterdir():
        if file.name != METADATA:
            (store / file.name).symlink_to(file)
    write_metadata(store / METADATA, metadata)


@damages(20, 150)
def test_damaged_manifests(roots, tmp_path, random: Random):
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(roots["itar"], folder / "clip"))
        manifest = root / f"{NAME}.json"
        if random.randrange(3):
            content = mutate_json(random, json.loads(manifest.read_text()))
            manifest.write_text(json.dumps(content))
            done = "a value"
        elif random.randrange(2):
            manifest.write_text(json.dumps(random.choice(JUNK)))
            done = "another file"
        else:
            done = mutate_text(random, manifest)
        sound_or_refused(root, folder / "out", done, unpacked=False)
