"""What converters to drive folders share."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from drivesplat.errors import DatasetError
from drivesplat.readers.drive.check import check
from drivesplat.readers.drive.conversion import timed_poses, write_folder


@pytest.fixture
def image(tmp_path) -> Path:
    Image.new("RGB", (80, 60), (90, 120, 60)).save(tmp_path / "one.png")
    return tmp_path / "one.png"


def record(**changes: Any) -> dict[str, Any]:
    mount = {"translation": [1.7, 0.0, 1.5], "rotation": [0.5, -0.5, 0.5, -0.5]}
    camera = {"width": 80, "height": 60, "K": [[70, 0, 40], [0, 70, 30], [0, 0, 1]], "sensor_to_ego": mount}
    frame = {"camera": "front", "timestamp": 1_000_000, "file": "front/1.png"}
    poses = timed_poses(np.array([900_000, 1_100_000]), np.stack([np.eye(4)] * 2))
    return {
        "format": "drivesplat drive", "version": 1, "cameras": {"front": camera}, "ego_poses": poses, "frames": [frame],
        "lidars": {"top": {"sensor_to_ego": {"translation": [0, 0, 2], "rotation": [1, 0, 0, 0]}}},
        "sweeps": [{"lidar": "top", "timestamp": 1_000_000, "file": "top/1.npz"}], **changes,
    }  # fmt: skip


def test_a_folder_holds_the_record_the_images_and_the_sweeps(image, tmp_path):
    points = {name: np.array([5.0, 6.0], dtype=np.float32) for name in "xyz"}
    path = write_folder(tmp_path / "out", record(), {"front/1.png": image}, [("top/1.npz", points)])
    assert path == tmp_path / "out/drive.json" and json.loads(path.read_text())["frames"][0]["file"] == "front/1.png"
    assert (tmp_path / "out/front/1.png").samefile(image), "linked where the file system allows it"
    assert check(tmp_path / "out", None) == []


def test_nothing_is_written_over(image, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.txt").write_text("keep")
    for place in (tmp_path / "out", image):
        with pytest.raises(DatasetError, match="is not empty; name a new folder"):
            write_folder(place, record(), {"front/1.png": image})
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["mine.txt"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"version": 2}, "drive.json: version is 2"),
        ({"frames": [], "sweeps": [{}]}, "more faults"),
        ({"ego_poses": timed_poses(np.array([100_000]), np.eye(4)[None])}, "outside the ego poses' time"),
        ({"origin": [float("nan"), 0.0, 0.0]}, "a number is not finite"),
        (None, r"1 of 1 images are missing \(first: .*none\.png\)"),
    ],
)
def test_a_record_with_faults_leaves_no_files(changes, words, image, tmp_path):
    def sweeps():
        raise DatasetError("a corrupt scan")
        yield

    file = tmp_path / "none.png" if changes is None else image
    with pytest.raises(DatasetError, match=words):
        write_folder(tmp_path / "out", record(**(changes or {})), {"front/1.png": file})
    assert not [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    with pytest.raises(DatasetError, match="a corrupt scan"):
        write_folder(tmp_path / "out", record(), {"front/1.png": image}, sweeps())
    assert not (tmp_path / "out/drive.json").exists()
