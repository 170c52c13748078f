"""Long drives cut into blocks: by length of path, at places passed again, at jumps; and the scenes of blocks."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from helpers.long_paths import EVERY, STEP_US, drive_along, straight
from helpers.scan_drives import track_of

from drivesplat.errors import DatasetError
from drivesplat.preprocess.blocks import MAX_AT_PLACE, block_scene, cut_into_blocks
from drivesplat.scene.blocks import Blocks, read_blocks, within, write_blocks
from drivesplat.scene.scene import Scene
from drivesplat.scene.sensors import Camera
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.blocks import BlockSettings, BlocksJob, block_scene_name, drive_of
from drivesplat.settings.images import HoldoutSettings

HOLDOUT = HoldoutSettings()


def cut(scene: Scene, **settings) -> Blocks:
    return cut_into_blocks(scene, job(**settings))


def job(**settings) -> BlocksJob:
    return BlocksJob(blocks=BlockSettings(**{"length_m": 100.0, "overlap_m": 20.0, **settings}), holdout=HOLDOUT)


def owners(blocks: Blocks, scene: Scene) -> list[int]:
    """The blocks of the images, each once in a row."""
    found = [blocks.at(frame.timestamp) for frame in scene.frames]
    return [number for i, number in enumerate(found) if i == 0 or found[i - 1] != number]


@pytest.mark.parametrize(("metres", "count"), [(40, 1), (149, 1), (151, 2), (249, 2), (1010, 10)])
def test_blocks_have_the_length_of_the_settings_and_the_last_takes_a_short_rest(metres, count):
    scene = drive_along(straight(metres))
    blocks = cut(scene)
    assert len(blocks.blocks) == count and owners(blocks, scene) == list(range(count))
    for block in blocks.blocks[:-1]:
        assert np.ptp(block.path[:, 0]) == pytest.approx(100.0, abs=2.0)


def test_every_recording_is_in_one_core_and_overlaps_reach_as_far_as_the_settings_say():
    scene = drive_along(straight(400))
    blocks, stamps = cut(scene), np.array([frame.timestamp for frame in scene.frames])
    assert (sum(within(stamps, block.core).astype(int) for block in blocks.blocks) == 1).all()
    places = np.array([frame.ego_to_world[0, 3] for frame in scene.frames])
    for number, block in enumerate(blocks.blocks):
        used = places[within(stamps, block.used)]
        assert used.min() == pytest.approx(max(0.0, 100.0 * number - 20.0), abs=2.0)
        assert used.max() == pytest.approx(min(399.0, 100.0 * number + 120.0), abs=2.0)


def test_a_vehicle_that_stands_for_minutes_makes_no_block():
    standing = np.repeat([[60.0, 0.0]], 3000, axis=0) + np.random.default_rng(0).normal(0.0, 0.05, (3000, 2))
    scene = drive_along(np.concatenate([straight(60), standing, straight(120, start=60.0)]))
    blocks = cut(scene)
    assert len(blocks.blocks) == 1
    own = block_scene(scene, blocks, 0, HOLDOUT)
    groups = frame_groups(own, HOLDOUT)
    along = np.array([frame.ego_to_world[0, 3] for frame in own.frames]) + own.origin[0] - scene.origin[0]
    trained = [group == "train" and 59.5 < place < 60.5 for group, place in zip(groups, along, strict=True)]
    assert 5 <= sum(trained) <= MAX_AT_PLACE + 10, "of 3000"
    everything = frame_groups(scene, HOLDOUT)
    for group in ("interpolation", "extrapolation"):
        assert groups.count(group) == everything.count(group) > 0
    for frame in own.frames:
        if frame.is_key_frame:
            assert own.key_frame_timestamps[frame.sample_index] == frame.timestamp


def square(laps: float) -> np.ndarray:
    """A way around a block of houses with edges of 100 m."""
    arcs = np.arange(0.0, 400.0 * laps, 1.0)
    edge, along = np.divmod(arcs % 400.0, 100.0)
    corners, ways = np.array([[0, 0], [100, 0], [100, 100], [0, 100]]), np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    return corners[edge.astype(int)] + along[:, None] * ways[edge.astype(int)]


def test_places_that_are_passed_again_belong_to_the_block_of_the_first_time():
    once, twice = drive_along(square(0.98)), drive_along(square(1.98))
    assert owners(cut(once), once) == [0, 1, 2, 3]
    blocks = cut(twice)
    assert len(blocks.blocks) == 4 and owners(blocks, twice) == [0, 1, 2, 3, 0, 1, 2, 3]
    assert all(len(block.core) == 2 for block in blocks.blocks)
    for lap in range(2):
        for frame in (frame for i, frame in enumerate(twice.frames) if i // 400 == lap and i % 100 == 50):
            number = blocks.at(frame.timestamp)
            assert np.abs(blocks.blocks[number].path - frame.ego_to_world[:2, 3]).sum(axis=1).min() < 2.0


def test_a_crossing_is_no_place_that_is_passed_again():
    there = straight(200)
    back = np.stack([np.full(200, 100.0), np.linspace(100.0, -100.0, 200)], axis=1)
    around = np.concatenate([np.linspace([200, 0], [200, 100], 100), np.linspace([200, 100], [100, 100], 100)])
    scene = drive_along(np.concatenate([there, around, back]))
    assert owners(cut(scene), scene) == list(range(6))


def test_a_jump_ends_a_block_and_nothing_overlaps_it():
    scene = drive_along(np.concatenate([straight(70), straight(5070, start=5000.0)]))
    blocks = cut(scene)
    assert owners(blocks, scene) == [0, 1]
    assert [block.used.tolist() for block in blocks.blocks] == [block.core.tolist() for block in blocks.blocks]


def previous(blocks: Blocks) -> list[int | None]:
    return [block.previous for block in blocks.blocks]


def test_the_previous_block_is_the_one_that_the_vehicle_comes_from_and_shares_recordings_with():
    assert previous(cut(drive_along(straight(400)))) == [None, 0, 1, 2]
    assert previous(cut(drive_along(straight(400)), overlap_m=0.0)) == [None] * 4, "they share nothing"
    jumped = np.concatenate([straight(170), straight(5170, start=5000.0)])
    assert previous(cut(drive_along(jumped))) == [None, 0, None, 2]
    assert previous(cut(drive_along(square(1.98)))) == [None, 0, 1, 2], "what was driven before is no further block"


def test_behind_a_street_that_was_driven_before_the_previous_block_is_that_of_the_street():
    corners = np.array([[0, 0], [200, 0], [200, 100], [0, 100], [0, 0], [50, 0], [50, -200]])
    legs = [np.linspace(a, b, int(np.abs(b - a).sum()), endpoint=False) for a, b in pairwise(corners)]
    scene = drive_along(np.concatenate(legs))
    blocks = cut(scene)
    assert owners(blocks, scene) == [0, 1, 2, 3, 4, 5, 0, 6, 7] and previous(blocks) == [None, 0, 1, 2, 3, 4, 0, 6]


def test_a_gap_in_the_path_leaves_out_no_number():
    """A ferry with a recording that pauses: 4.8 km in half an hour."""
    places = np.concatenate([straight(200), straight(5200, start=5000.0)])
    stamps = np.arange(len(places)) * STEP_US + np.where(places[:, 0] > 1000, 1_800_000_000, 0) + 1_000_000
    scene = drive_along(places, stamps=stamps)
    blocks = cut(scene)
    assert owners(blocks, scene) == list(range(len(blocks.blocks))) and len(blocks.blocks) > 2


@pytest.mark.parametrize("beyond", [153, 300], ids=["one glitch", "a jump at the end"])
def test_stretches_without_key_frames_to_train_on_join_others(beyond):
    places = straight(300)
    places[max(152, beyond - 2) : beyond, 1] += 50.0
    scene = drive_along(places)
    blocks = cut(scene)
    for number in range(len(blocks.blocks)):
        own = block_scene(scene, blocks, number, HOLDOUT)
        assert frame_groups(own, HOLDOUT).count("train") > 5
    assert len(blocks.blocks) in (3, 4)


def test_held_out_images_are_not_trained_on_where_key_frames_have_times_of_their_own():
    scene = drive_along(straight(400))
    scene = replace(scene, key_frame_timestamps=scene.key_frame_timestamps - 50_000)
    holdout = HoldoutSettings(offset=3)
    groups = dict(zip((frame.token for frame in scene.frames), frame_groups(scene, holdout), strict=True))
    blocks = cut_into_blocks(scene, BlocksJob(blocks=BlockSettings(length_m=97, overlap_m=20), holdout=holdout))
    for number in range(len(blocks.blocks)):
        own = block_scene(scene, blocks, number, holdout)
        for frame, group in zip(own.frames, frame_groups(own, holdout), strict=True):
            assert group != "train" or groups[frame.token] not in ("interpolation", "extrapolation")


def test_the_digest_changes_with_the_lens_of_a_camera_and_with_the_origin():
    camera = Camera("front", 16, 9, np.eye(3), readout_s=0.03)
    scene = replace(drive_along(straight(400)), cameras=(camera,))
    before = cut(scene)
    for changed in (
        replace(scene, cameras=(replace(camera, readout_s=0.02),)),
        replace(scene, origin=scene.origin + 1.0),
    ):
        assert all(one.digest != two.digest for one, two in zip(before.blocks, cut(changed).blocks, strict=True))


def test_blocks_do_not_depend_on_how_the_drive_goes_on():
    short, long = (cut(drive_along(straight(metres))) for metres in (600, 1000))
    for number in range(len(short.blocks) - 1):
        one, other = short.blocks[number], long.blocks[number]
        assert one.digest == other.digest and one.digest and np.array_equal(one.path, other.path)
    assert short.blocks[-1].digest != long.blocks[len(short.blocks) - 1].digest


def test_the_digest_changes_with_a_pose_of_the_block_alone():
    scene = drive_along(straight(400))
    moved = scene.frames[10].camera_to_world.copy()
    moved[0, 3] += 1e-3
    frames = (*scene.frames[:10], replace(scene.frames[10], camera_to_world=moved), *scene.frames[11:])
    before, after = cut(scene), cut(replace(scene, frames=frames))
    assert [one.digest == two.digest for one, two in zip(before.blocks, after.blocks, strict=True)] == [
        False, True, True, True,
    ]  # fmt: skip


def test_the_scene_of_a_block_has_its_recordings_in_a_world_of_its_own():
    car = track_of("car", [[10.0 * i, 5.0, 1.0] for i in range(80)])
    car = replace(car, timestamps=car.sample_indices * EVERY * STEP_US + 1_000_000)
    scene = drive_along(straight(400), car)
    blocks = cut(scene)
    own = block_scene(scene, blocks, 2, HOLDOUT)
    assert own.name == "long.002" and own.frames[0].timestamp == blocks.blocks[2].used[0, 0]
    assert np.array_equal(own.key_frame_timestamps, [f.timestamp for f in own.frames if f.is_key_frame])
    for frame in own.frames:
        (whole,) = [one for one in scene.frames if one.token == frame.token]
        for name in ("camera_to_world", "ego_to_world"):
            assert np.allclose(getattr(frame, name)[:3, 3] + own.origin, getattr(whole, name)[:3, 3] + scene.origin)
        if frame.is_key_frame:
            assert own.key_frame_timestamps[frame.sample_index] == frame.timestamp
    (track,) = own.tracks
    assert np.array_equal(own.key_frame_timestamps[track.sample_indices], track.timestamps)
    known = dict(zip(car.timestamps.tolist(), car.object_to_world, strict=True))
    for stamp, pose in zip(track.timestamps.tolist(), track.object_to_world, strict=True):
        assert np.allclose(pose[:3, 3] + own.origin, known[stamp][:3, 3] + scene.origin)


def test_held_out_key_frames_are_those_of_the_drive_and_measured_in_one_block():
    scene = drive_along(straight(400))
    groups = {frame.token: group for frame, group in zip(scene.frames, frame_groups(scene, HOLDOUT), strict=True)}
    blocks, measured = cut(scene), []
    for number in range(len(blocks.blocks)):
        own = block_scene(scene, blocks, number, HOLDOUT)
        kept = set(own.key_frame_timestamps.tolist())
        for frame, group in zip(own.frames, frame_groups(own, HOLDOUT), strict=True):
            near = {int(time) for time in scene.key_frame_timestamps if abs(time - frame.timestamp) < 250_000}
            if groups[frame.token] == "train":
                assert group == "train"
            elif near <= kept:  # an image near a key frame of another block alone may be trained on
                assert group in ("excluded", groups[frame.token])
            measured += [frame.token] if group in ("interpolation", "extrapolation") else []
    wanted = [token for token, group in groups.items() if group in ("interpolation", "extrapolation")]
    assert sorted(measured) == sorted(wanted) and len(wanted) > 8


def test_blocks_without_key_frames_or_paths_are_refused_in_a_sentence():
    with pytest.raises(DatasetError, match="scene long: blocks follow the path of the vehicle, and it has none"):
        cut(drive_along(np.zeros((50, 2))))
    scene = drive_along(straight(400))
    blocks = cut(scene)
    with pytest.raises(DatasetError, match=r"scene long.001: the block has no key frame; make blocks longer"):
        block_scene(replace(scene, key_frame_timestamps=scene.key_frame_timestamps[:1]), blocks, 1, HOLDOUT)


def test_blocks_are_read_as_they_were_written(tmp_path):
    blocks = cut(drive_along(square(2)))
    write_blocks(tmp_path / "blocks.json", blocks)
    found = read_blocks(tmp_path / "blocks.json")
    assert found.names == ["long.000", "long.001", "long.002", "long.003"]
    for one, two in zip(found.blocks, blocks.blocks, strict=True):
        assert np.array_equal(one.core, two.core) and np.array_equal(one.used, two.used) and one.digest == two.digest
        assert np.array_equal(one.path, two.path)


def test_blocks_are_named_by_their_drive():
    assert block_scene_name("long", 12) == "long.012" and drive_of("long.012") == "long"
    assert drive_of("long") == "long" and drive_of("a.1") == "a.1" and drive_of(block_scene_name("x", 1234)) == "x"
