"""200 damaged inputs: a drive is read as a sound scene or refused in one line, in time."""

import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import pytest
from helpers.drives import uncompared
from helpers.mutations import damages, fresh, likely, mutate_bytes, mutate_table, some_bytes
from helpers.table_files import VERSION, copy_of, extracted, time_limit
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.preprocess.masks import make_masks
from drivesplat.readers.nuscenes.layout import TABLES
from drivesplat.readers.sweeps import read_returns
from drivesplat.scene.scene import Scene, read_scene, write_scene
from drivesplat.settings.masks import MaskJob

USED = [table for table in TABLES if table not in ("attribute", "visibility")]
LARGE = ["sample", "sample_data", "ego_pose", "calibrated_sensor", "sample_annotation"]


@pytest.fixture(scope="module")
def small_scene(small_root) -> Scene:
    return extracted(small_root, sweeps=False)


def one_line(error: DatasetError, done: object) -> None:
    """A refusal is one line that says something, and does not blame the results."""
    message = str(error)
    assert "\n" not in message and 10 < len(message) < 1000, done


def require_sound(scene: Scene, root: Path, folder: Path) -> None:
    """What the checks of readers promise, computed in other ways than they do."""
    times = scene.key_frame_timestamps
    assert len(times) and (np.diff(times) > 0).all() and times[0] >= 0 and times[-1] <= 1e17
    assert len(times) < 2 or np.median(np.diff(times)) >= 1000
    require_rigid(np.stack([f.camera_to_world for f in scene.frames]), 3e8)
    require_rigid(np.stack([f.ego_to_world for f in scene.frames]), 3e8)
    require_rigid(np.stack([s.sensor_to_world for s in scene.sweeps]), 3e8) if scene.sweeps else None
    assert len({f.token for f in scene.frames}) == len(scene.frames) > 0
    for records in (scene.frames, scene.sweeps):
        assert all(b.timestamp > a.timestamp for a, b in pairwise(records))
        assert all(type(it.is_key_frame) is bool and type(it.timestamp) is int for it in records)
        key_frames = [it.sample_index for it in records if it.is_key_frame]
        assert key_frames == list(range(len(times))) or not records or scene.missing_images
    for frame in scene.frames:
        fx, fy, cx, cy = frame.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]]
        assert 0 <= cx <= frame.width and 0 <= cy <= frame.height
        assert all(0.1 * frame.width <= focal <= 20 * frame.width for focal in (fx, fy))
        assert root in Path(frame.image_path).parents and ".." not in Path(frame.image_path).parts
    for track in scene.tracks:
        require_rigid(track.object_to_world, 3e8)
        assert ((track.size > 0) & (track.size <= 1000)).all() and (np.diff(track.timestamps) > 0).all()
        assert len(set(track.sample_indices.tolist())) == len(track.timestamps)
    write_scene(folder / "scene.json", scene)
    assert repr(read_scene(folder / "scene.json").tracks) == repr(scene.tracks)


def require_rigid(poses: np.ndarray, bound: float) -> None:
    assert np.isfinite(poses).all() and np.abs(poses).max() <= bound
    np.testing.assert_allclose(np.linalg.det(poses[:, :3, :3]), 1.0, atol=1e-6)
    np.testing.assert_allclose(
        poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2), np.eye(3)[None].repeat(len(poses), 0), atol=1e-6
    )


@damages(40, 140)
def test_damaged_tables_are_refused_in_one_line_or_give_a_sound_scene(small_root, tmp_path, random):
    with fresh(tmp_path) as folder:
        root = copy_of(small_root, folder / "data")
        done = [mutate_table(random, root / VERSION / f"{random.choice(USED + 2 * LARGE)}.json")]
        try:
            with uncompared(unless=likely(random, 3)):
                scene = extracted(root, on_missing=random.choice(["stop", "warn"]))
        except DatasetError as error:
            one_line(error, done)
        else:
            require_sound(scene, root, folder)


@damages(8, 15)
def test_damaged_images_are_refused_in_one_line_or_read(small_root, tmp_path, random):
    with fresh(tmp_path) as folder:
        root = Path(shutil.copytree(small_root, folder / "data"))
        done = mutate_bytes(random, random.choice(sorted(root.glob("s*/CAM_FRONT/*"))))
        try:
            require_sound(extracted(root), root, folder)
        except DatasetError as error:
            one_line(error, done)
            assert "image" in str(error), done


@damages(10, 20)
def test_damaged_sweeps_are_refused_in_one_line_or_have_returns_near_the_sensor(small_scene, tmp_path, random):
    with fresh(tmp_path) as folder:
        sweep = small_scene.sweeps[random.randrange(len(small_scene.sweeps))]
        sweep = replace(sweep, path=shutil.copy(sweep.path, folder))
        done = mutate_bytes(random, Path(sweep.path))
        try:
            with time_limit():
                returns = read_returns(sweep)
        except DatasetError as error:
            one_line(error, done)
            assert sweep.path in str(error)
        else:
            assert len(returns.points) and np.linalg.norm(returns.points, axis=1).max() < 2000.0, done
            assert np.isfinite(returns.intensity).all() and (returns.rings >= -1).all(), done


def random_mask(random: Random, path: Path) -> str:
    """A mask of a random mode, size and content, which may also be damaged as a file."""
    mode = random.choice(["L", "L", "1", "P", "RGB", "RGBA", "LA", "I;16", "I", "F", "CMYK"])
    size = random.choice([(48, 27), (48, 27), (96, 54), (24, 14), (48, 48), (27, 48), (1, 1), (480, 27)])
    image = Image.frombytes(mode, size, some_bytes(random, bytes_of(mode, size)))
    image.save(path, format="TIFF" if mode in ("I", "F", "CMYK") else "PNG")
    return f"{mode} {size}" + (mutate_bytes(random, path) if likely(random, 3) else "")


def bytes_of(mode: str, size: tuple[int, int]) -> int:
    per_pixel = {"RGB": 3, "RGBA": 4, "LA": 2, "I;16": 2, "I": 4, "F": 4, "CMYK": 4}.get(mode, 1)
    return (size[0] + 7) // 8 * size[1] if mode == "1" else per_pixel * size[0] * size[1]


@damages(12, 25)
def test_damaged_masks_are_refused_in_one_line_or_give_labels_of_the_image(small_scene, tmp_path, random):
    kind = random.choice(["sky_folder", "semantic_folder", "regions_folder"])
    with fresh(tmp_path) as empty:
        folder = empty / "mine" / "CAM_FRONT"
        folder.mkdir(parents=True)
        for frame in small_scene.frames:
            Image.new("L", (48, 27)).save(folder / f"{frame.timestamp}.png")
        done = f"{kind} {random_mask(random, folder / f'{small_scene.frames[1].timestamp}.png')}"
        job = MaskJob.model_validate({"masks": {kind: str(folder.parent)}, "holdout": {}, "images": {}})
        try:
            with time_limit():
                record = make_masks(small_scene, job, empty / "masks")
        except DatasetError as error:
            one_line(error, done)
            assert str(folder) in str(error), done
        else:
            refused = ("RGB", "I;16", "I (", "F (", "CMYK", "(48, 48)", "(27, 48)", "(480, 27)")
            assert not any(it in done for it in refused), done
            assert record.images == len(small_scene.frames)
