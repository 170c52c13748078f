"""Effects of the settings of a synthetic world; equal settings give equal bytes."""

import json
from pathlib import Path

import numpy as np
import pytest
from helpers.demo_worlds import CAMERAS, FRONT, job_of, names_of, recorder_of, world_of
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from drivesplat.world.generate import make_world
from drivesplat.world.optics.imaging import to_bytes
from drivesplat.world.recorder import Viewpoint


@pytest.mark.slow
def test_where_nothing_moves_no_vehicle_leads_and_images_are_equal_and_a_new_world_replaces_the_old_one(tmp_path):
    """With LiDAR sweeps between key frames, and without."""
    still = {"width": 64, "key_frames": 2, "vehicles": 0, "pedestrians": 0, "ego": "stands"}
    job = job_of(world_of(cameras=CAMERAS[:2], sweeps=("LIDAR_TOP",), **still))
    make_world(tmp_path, job, {"stages": {}}, workers=1)
    attributes = {row["token"]: row["name"] for row in table(tmp_path, "attribute")}
    used = {attributes[token] for row in table(tmp_path, "sample_annotation") for token in row["attribute_tokens"]}
    assert used == {"vehicle.parked"}
    poses = {json.dumps([row["translation"], row["rotation"]]) for row in table(tmp_path, "ego_pose")}
    assert len(poses) == 1, "the ego vehicle stands"
    first, last = (np.asarray(Image.open(path)) for path in sorted(tmp_path.glob(f"samples/{CAMERAS[1]}/*")))
    np.testing.assert_array_equal(first, last)
    truth = json.loads((tmp_path / "truth/truth.json").read_text())
    assert truth["leading"] is None and not any(view["without"] for view in truth["views"])
    assert {path.name for path in (tmp_path / "truth").iterdir()} == {"truth.json", "CAM_FRONT"}
    views = {"recorded", "left_2m", "right_2m", "left_4m"}
    assert {path.name for path in (tmp_path / "truth/CAM_FRONT").iterdir()} == views
    before, log = files(tmp_path), table(tmp_path, "log")
    bare = job_of(world_of(parked=0, **still))
    make_world(tmp_path, bare, {"stages": {"demo_world": {"code": "new"}}}, workers=1)
    images = {str(path.relative_to(tmp_path)) for path in tmp_path.glob("samples/*/*")}
    assert len(images) == 2 * 2 and not (tmp_path / "sweeps").exists()
    assert images == {data["filename"] for data in table(tmp_path, "sample_data")}
    assert all((tmp_path / name).read_bytes() != before[name] for name in images if "CAM_FRONT" in name)
    assert table(tmp_path, "log") != log, "what is made from the tables is to be remade"


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def table(root: Path, name: str) -> list[dict]:
    return json.loads((root / "v1.0-mini" / f"{name}.json").read_text())


@pytest.mark.slow
def test_the_same_settings_give_the_same_bytes_with_one_worker_and_with_two(tmp_path):
    light = {"night": True, "wet": True, "class_maps": True, "truth": {"lidar": True}}
    counts = {"vehicles": 1, "parked": 2, "pedestrians": 1, "cyclists": 1, "bystanders": 1, "dogs": 1}
    tiny = job_of(world_of(width=64, key_frames=2, **counts, **light))
    for workers in (1, 2):
        make_world(tmp_path / str(workers), tiny, {"stages": {"demo_world": {"code": "x"}}}, workers)
    one, two = files(tmp_path / "1"), files(tmp_path / "2")
    assert len(one) > 30 and one.keys() == two.keys()
    assert [name for name in one if one[name] != two[name]] == []


def test_images_by_night_have_sensor_noise_and_the_truth_has_none():
    night, without = recorder_of(night=True), Viewpoint(without="vehicle 0")
    true, again = (to_bytes(night.picture(FRONT, 500_000, without).radiance) for _ in range(2))
    np.testing.assert_array_equal(true, again)
    image = night.image(FRONT, 500_000).astype(float)
    own = night.geometry(FRONT, 500_000).objects == names_of(night).index("vehicle 0")
    away = ~binary_dilation(own, iterations=2)
    lit = away & (image.min(axis=2) > 20) & (image.max(axis=2) < 235)
    difference = (image - true)[lit]
    assert lit.sum() > 1000
    assert difference.std() == pytest.approx(0.012 * 255, rel=0.15) and abs(difference.mean()) < 0.3


def test_noisy_poses_are_flat_tilted_by_half_a_degree_and_off_by_centimetres_without_jumps():
    """At 12 Hz over a drive of 20 key frames."""
    times = np.arange(0.0, 9.5, 1 / 12)
    recorders = (recorder_of(pose_noise=noise) for noise in (True, False))
    noisy, exact = (np.array([recorder.ego_to_global(float(t)) for t in times]) for recorder in recorders)
    assert (noisy[:, 2, 3] == 0.0).all() and np.ptp(exact[:, 2, 3]) > 0.005
    turn = Rotation.from_matrix(np.swapaxes(exact[:, :3, :3], 1, 2) @ noisy[:, :3, :3])
    roll, pitch, yaw = np.degrees(turn.as_euler("xyz")).T
    for angle in (roll, pitch):
        assert 0.2 < np.median(np.abs(angle)) < 1.5 and np.abs(angle).max() < 1.5
    assert np.abs(yaw).max() < 0.05
    offset = (noisy - exact)[:, :2, 3]
    distance = np.linalg.norm(offset, axis=1)
    assert 0.01 < np.median(distance) < 0.08 and distance.max() < 0.1
    assert np.linalg.norm(np.diff(offset, axis=0), axis=1).max() < 0.02
    ups = noisy[:, :3, 2]
    steps = np.degrees(np.arccos(np.clip((ups[1:] * ups[:-1]).sum(axis=1), -1, 1)))
    assert steps.max() < 0.4, "no jumps between images"
