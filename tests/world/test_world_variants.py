"""Effects of the settings of a synthetic world; equal settings give equal bytes."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers.demo_worlds import CAMERAS, FRONT, job_of, names_of, recorder_of, world_of
from PIL import Image
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from drivesplat.world.generate import make_world
from drivesplat.world.optics.imaging import to_bytes
from drivesplat.world.recorder import Recorder, Viewpoint

STILL = job_of(
    world_of(
        width=64, cameras=CAMERAS, key_frames=2, vehicles=0, pedestrians=0, ego="stands", sweeps=("LIDAR_TOP",)
    )
)  # fmt: skip


def files(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def table(root: Path, name: str) -> list[dict]:
    return json.loads((root / "v1.0-mini" / f"{name}.json").read_text())


@pytest.fixture(scope="module")
def still_street(tmp_path_factory) -> Path:
    """A static world with LiDAR sweeps between key frames."""
    root = tmp_path_factory.mktemp("still")
    make_world(root, STILL, {"stages": {}}, workers=2)
    return root


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


def test_making_a_world_anew_replaces_the_old_one(tmp_path, still_street):
    root = tmp_path / "again"
    shutil.copytree(still_street, root)
    bare = STILL.world.model_copy(update={"sweeps": (), "parked": 0})
    make_world(root, STILL.model_copy(update={"world": bare}), {"stages": {"demo_world": {"code": "new"}}}, 2)
    images = {str(path.relative_to(root)) for path in root.glob("samples/*/*")}
    assert len(images) == 2 * 7 and not (root / "sweeps").exists()
    assert images == {data["filename"] for data in table(root, "sample_data")}
    for path in root.glob("samples/CAM_FRONT/*"):
        assert path.read_bytes() != (still_street / path.relative_to(root)).read_bytes()
    assert table(root, "log") != table(still_street, "log"), "what is made from the tables is to be remade"


def test_where_nothing_moves_no_vehicle_leads_and_images_are_equal(still_street):
    attributes = {row["token"]: row["name"] for row in table(still_street, "attribute")}
    used = {attributes[token] for row in table(still_street, "sample_annotation") for token in row["attribute_tokens"]}
    assert used == {"vehicle.parked"}
    poses = {json.dumps([row["translation"], row["rotation"]]) for row in table(still_street, "ego_pose")}
    assert len(poses) == 1, "the ego vehicle stands"
    first, last = (np.asarray(Image.open(path)) for path in sorted(still_street.glob("samples/CAM_BACK/*")))
    np.testing.assert_array_equal(first, last)
    truth = json.loads((still_street / "truth" / "truth.json").read_text())
    assert truth["leading"] is None and not any(view["without"] for view in truth["views"])
    assert {path.name for path in (still_street / "truth").iterdir()} == {"truth.json", "CAM_FRONT"}
    views = {"recorded", "left_2m", "right_2m", "left_4m"}
    assert {path.name for path in (still_street / "truth/CAM_FRONT").iterdir()} == views


@pytest.fixture(scope="module")
def night() -> Recorder:
    return recorder_of(night=True)


def without_leading(recorder: Recorder, time_us: int) -> np.ndarray:
    """The truth of an image without the vehicle ahead (h, w, 3)."""
    return to_bytes(recorder.picture(FRONT, time_us, Viewpoint(without="vehicle 0")).radiance)


def test_images_by_night_have_sensor_noise_and_the_truth_has_none(night):
    image, without = night.image(FRONT, 500_000).astype(float), without_leading(night, 500_000)
    own = night.geometry(FRONT, 500_000).objects == names_of(night).index("vehicle 0")
    away = ~binary_dilation(own, iterations=2)
    lit = away & (image.min(axis=2) > 20) & (image.max(axis=2) < 235)
    difference = (image - without)[lit]
    assert lit.sum() > 1000
    assert difference.std() == pytest.approx(0.012 * 255, rel=0.15) and abs(difference.mean()) < 0.3
    np.testing.assert_array_equal(without, without_leading(night, 500_000))


@pytest.fixture(scope="module")
def noisy_and_exact():
    """Noisy and exact poses at 12 Hz over a drive of 20 key frames."""
    times = np.arange(0.0, 9.5, 1 / 12)
    noisy, exact = (recorder_of(pose_noise=noise) for noise in (True, False))
    return [np.array([recorder.ego_to_global(float(t)) for t in times]) for recorder in (noisy, exact)]


def test_noisy_poses_are_flat_and_tilted_by_half_a_degree(noisy_and_exact):
    noisy, exact = noisy_and_exact
    assert (noisy[:, 2, 3] == 0.0).all() and np.ptp(exact[:, 2, 3]) > 0.005
    turn = Rotation.from_matrix(np.swapaxes(exact[:, :3, :3], 1, 2) @ noisy[:, :3, :3])
    roll, pitch, yaw = np.degrees(turn.as_euler("xyz")).T
    for angle in (roll, pitch):
        assert 0.2 < np.median(np.abs(angle)) < 1.5 and np.abs(angle).max() < 1.5
    assert np.abs(yaw).max() < 0.05


def test_position_errors_are_centimetres_and_smooth(noisy_and_exact):
    noisy, exact = noisy_and_exact
    offset = (noisy - exact)[:, :2, 3]
    distance = np.linalg.norm(offset, axis=1)
    assert 0.01 < np.median(distance) < 0.08 and distance.max() < 0.1
    assert np.linalg.norm(np.diff(offset, axis=0), axis=1).max() < 0.02
    ups = noisy[:, :3, 2]
    steps = np.degrees(np.arccos(np.clip((ups[1:] * ups[:-1]).sum(axis=1), -1, 1)))
    assert steps.max() < 0.4, "no jumps between images"
