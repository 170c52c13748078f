"""A drive that was cut into blocks in Python: the block of a time, and poses in the world of the drive."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

import drivesplat
from drivesplat.errors import RequestError
from drivesplat.scene.blocks import Block, Blocks, write_blocks
from drivesplat.scene.scene import read_scene, write_scene

pytestmark = pytest.mark.workflow
SHIFT = np.array([10.0, -4.0, 0.0])
"""From the origin of the first block's world to that of the second's."""


@pytest.fixture(scope="module")
def results(finished_run, tmp_path_factory):
    """Results of a drive of two blocks, whose second half is the same drive in another world."""
    folder, made = tmp_path_factory.mktemp("long"), finished_run.folder / "results/0001"
    scene = read_scene(made / "scene.json")
    first, last = (int(pick(frame.timestamp for frame in scene.frames)) for pick in (min, max))
    middle = (first + last) // 2
    cores = [np.array([[first, middle]]), np.array([[middle, last + 1]])]
    used = np.array([[first, last + 1]])
    blocks = Blocks("way", tuple(Block(core, used, np.zeros((1, 2))) for core in cores))
    (folder / "way/street").mkdir(parents=True)
    write_blocks(folder / "way/blocks.json", blocks)
    write_scene(folder / "way/scene.json", replace(scene, name="way"))
    for number, name in enumerate(blocks.names):
        shutil.copytree(made, folder / name, ignore=shutil.ignore_patterns("*.mp4", "masks", "vanilla", "*.usdz"))
        write_scene(folder / name / "scene.json", replace(scene, name=name, origin=scene.origin + number * SHIFT))
    return folder


@pytest.fixture(scope="module")
def drive(results):
    return drivesplat.LongDrive(results / "way/street", device="cpu")


def test_a_time_is_shown_by_the_block_in_which_the_vehicle_is(drive):
    early, late = 0.2 * drive.duration, 0.8 * drive.duration
    assert [drive.at(time)[0].scene.name for time in (0.0, early, late, drive.duration)] == [
        "way.000", "way.000", "way.001", "way.001",
    ]  # fmt: skip
    block, seconds = drive.at(late)
    assert block is drive.block(1) and seconds == pytest.approx(late, abs=1e-6)
    view = drive.render("CAM_FRONT", late, outputs=("rgb", "alpha"))
    assert np.array_equal(view.image, block.render("CAM_FRONT", seconds).image)
    one, two = drive.render(["CAM_FRONT", "CAM_FRONT"], late)
    assert np.array_equal(one.image, two.image) and np.array_equal(one.image, view.image)
    assert repr(drive).endswith("in 2 blocks>")


def test_poses_are_those_of_the_drive(drive):
    late = 0.8 * drive.duration
    block, seconds = drive.at(late)
    pose = block.camera_to_world("CAM_FRONT", seconds)
    of_drive = pose.copy()
    of_drive[:3, 3] += SHIFT
    image = drive.render("CAM_FRONT", late, camera_to_world=of_drive).image
    assert np.array_equal(image, block.render("CAM_FRONT", seconds, camera_to_world=pose).image)
    assert not np.array_equal(image, drive.render("CAM_FRONT", late, camera_to_world=pose).image)


def test_two_blocks_are_in_memory_at_most(results, monkeypatch):
    monkeypatch.setattr("drivesplat.drive.long_drive.MAX_OPEN", 1)
    drive = drivesplat.LongDrive(results / "way/street", device="cpu")
    first = drive.block(0)
    assert drive.block(0) is first
    drive.block(1)
    assert drive.block(0) is not first


def test_blocks_that_are_left_out_or_not_trained_are_refused(results, tmp_path):
    copied = shutil.copytree(results, tmp_path / "results")
    drive = drivesplat.LongDrive(copied / "way/street", device="cpu")
    late = 0.8 * drive.duration
    assert drive.left_out == []
    (copied / "way.001/street/checkpoint.npz").unlink()
    assert drive.left_out == [1]
    with pytest.raises(RequestError, match=r"block 1 of .*way/street is left out or not trained.*docs/long_drives.md"):
        drive.render("CAM_FRONT", late)
    assert drive.at(0.1)[0].scene.name == "way.000", "the others go on"
    (copied / "way/street/eval.json").write_text('{"protocol": {"left_out": ["way.000"]}}')
    assert drive.left_out == [0, 1]


def test_what_is_no_long_drive_and_unknown_times_and_blocks_are_refused(results, drive):
    with pytest.raises(RequestError, match=r"way.000 has no blocks.json: it is no drive that is cut into blocks"):
        drivesplat.LongDrive(results / "way.000/street")
    with pytest.raises(RequestError, match=r"way is cut into blocks: use drivesplat.LongDrive, or open one"):
        drivesplat.open(results / "way/street")
    with pytest.raises(RequestError, match=r"was recorded from 0 to .* s, not at -1 s"):
        drive.render("CAM_FRONT", -1.0)
    with pytest.raises(RequestError, match=r"has no block 2; it has 2, from 0 on"):
        drive.block(2)
    with pytest.raises(RequestError, match="camera"):
        drive.render("CAM_FRONT", 0.5, camera_to_world=np.eye(3))
