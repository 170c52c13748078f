"""A drive that was cut into blocks is served as one scene: its times choose the block, its poses are moved there."""

import dataclasses
import shutil
from pathlib import Path

import grpc
import numpy as np
import pytest
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from helpers.hand_made_street import AHEAD, street_model, street_scene
from helpers.scanned_street import scanned_street
from helpers.served_drives import image_request, object_of, pair_of, pose_of, served, write_mask, write_method
from helpers.trainings import PROVENANCE

from drivesplat.io.storage import write_json
from drivesplat.scene.blocks import Block, Blocks, read_blocks, write_blocks
from drivesplat.scene.scene import read_scene, write_scene

EMPTY = common_pb2.Empty()
SHIFT = np.array([100.0, -40.0, 0.0])
"""From the origin of the first block's world, which is the drive's, to that of the second's."""


@pytest.fixture(scope="module")
def drive(tiny_scene, tmp_path_factory) -> Path:
    """Results of the drive `way`: its two blocks are one drive in two worlds; the second has scans."""
    folder, scene = tmp_path_factory.mktemp("long"), street_scene(tiny_scene)
    first, last = (int(pick(frame.timestamp for frame in scene.frames)) for pick in (min, max))
    middle, used = (first + last) // 2, np.array([[first, last + 1]])
    cores = np.array([[[first, middle]], [[middle, last + 1]]])
    paths = np.zeros((1, 2)), SHIFT[None, :2]
    blocks = Blocks("way", tuple(Block(core, used, path) for core, path in zip(cores, paths, strict=True)))
    for number, name in enumerate(blocks.names):
        own = dataclasses.replace(scene, name=name, origin=scene.origin + number * SHIFT)
        model = scanned_street(own) if number else street_model()
        write_method(folder / name / "street", own, model, scans=bool(number))
        write_mask(folder / name)
    (folder / "way").mkdir()
    write_blocks(folder / "way/blocks.json", blocks)
    write_scene(folder / "way/scene.json", dataclasses.replace(scene, name="way"))
    return folder


@pytest.fixture(scope="module")
def client(drive):
    with served(drive) as (_, client):
        yield client


@pytest.fixture(scope="module")
def path(client) -> list[tuple[int, np.ndarray]]:
    """Timestamps and poses of the camera of the whole drive."""
    (camera,) = client.get_available_cameras(sensorsim_pb2.AvailableCamerasRequest(scene_id="way")).available_cameras
    request = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id="way")
    (found,) = client.get_available_trajectories(request).available_trajectories
    mount = pose_of(camera.rig_to_camera)
    return [(one.timestamp_us, pose_of(one.pose) @ mount) for one in found.trajectory.poses]


def moved(pose: np.ndarray, by) -> np.ndarray:
    there = pose.copy()
    there[:3, 3] += by
    return there


def test_a_long_drive_is_a_scene_beside_its_blocks(drive, client):
    expected = ["way", "way.000", "way.001"]
    assert [*client.get_available_scenes(EMPTY).scene_ids] == expected
    masks = client.get_available_ego_masks(EMPTY).ego_mask_metadata
    assert [mask.ego_mask_id.rig_config_id for mask in masks] == expected
    shutil.copytree(drive / "way.000/street", drive / "way.000/other")
    try:
        with served(drive) as (_, other):
            found = [*other.get_available_scenes(EMPTY).scene_ids]
    finally:
        shutil.rmtree(drive / "way.000/other")
    assert found == ["way/other", "way/street", "way.000/other", "way.000/street", "way.001"]


def test_a_frame_shows_the_block_of_its_time_where_the_request_looks(client, path):
    for at, block, shift in ((0, "way.000", np.zeros(3)), (-1, "way.001", SHIFT)):
        stamp, camera = path[at]
        ego = camera.copy()
        ego[:3, :3] = np.eye(3)
        car = moved(ego, [8.0, 0.0, -0.5])
        images = []
        for name, by in ((block, np.zeros(3)), ("way", shift)):
            seen, there = moved(camera, by), moved(car, by)
            asked = image_request(name, (stamp, stamp), (seen, seen), [object_of(AHEAD, there, there)])
            images.append(client.image(asked))
        assert np.array_equal(*images)
        assert not np.array_equal(images[0], client.image(image_request("way", (stamp, stamp), (seen, seen))))
    assert [*client.get_loaded_scenes(EMPTY).scenes][-1].scene_id == "way.001"


def test_a_rig_across_the_border_and_a_scan(client, path):
    ends = [path[0], (path[-1][0], moved(path[-1][1], SHIFT))]
    requests = [image_request("way", (stamp, stamp), (pose, pose)) for stamp, pose in ends]
    items = [
        sensorsim_pb2.BatchRGBRenderRequestItem(camera_name=str(i), request=request)
        for i, request in enumerate(requests)
    ]
    reply = client.batch_render_rgb(sensorsim_pb2.BatchRGBRenderRequest(items=items))
    assert [item.result.image_bytes for item in reply.items] == [client.render_rgb(one).image_bytes for one in requests]
    stamp, lidar = path[-1][0], moved(np.eye(4), path[-1][1][:3, 3])
    scans = [
        sensorsim_pb2.LidarRenderRequest(
            scene_id=name, frame_start_us=stamp - 100_000, frame_end_us=stamp, sensor_pose=pair_of(place, place)
        )
        for name, place in (("way", moved(lidar, SHIFT)), ("way.001", lidar))
    ]
    of_drive, of_block = map(client.render_lidar, scans)
    assert of_drive.num_points == of_block.num_points > 0
    np.testing.assert_allclose(of_drive.point_xyzs, of_block.point_xyzs, atol=1e-4)  # poses are in single precision


def test_a_rig_across_the_border_needs_one_block_at_a_time(drive, path):
    ends = [path[0], (path[-1][0], moved(path[-1][1], SHIFT))]
    items = [
        sensorsim_pb2.BatchRGBRenderRequestItem(request=image_request("way", (stamp, stamp), (pose, pose)))
        for stamp, pose in ends
    ]
    with served(drive, max_loaded=1) as (_, client):
        reply = client.batch_render_rgb(sensorsim_pb2.BatchRGBRenderRequest(items=items))
    assert [item.success for item in reply.items] == [True, True]


def test_a_batch_may_name_a_drive_and_its_block(client, path):
    """With objects of equal numbers, which are at different places."""
    stamp, camera = path[-1]
    ahead = moved(np.eye(4), camera[:3, 3] + [8.0, 0.0, -0.5])
    asked = [
        image_request(name, (stamp, stamp), (seen, seen), [object_of(AHEAD, ahead, ahead)])
        for name, seen in (("way.001", camera), ("way", moved(camera, SHIFT)))
    ]
    items = [sensorsim_pb2.BatchRGBRenderRequestItem(request=request) for request in asked]
    reply = client.batch_render_rgb(sensorsim_pb2.BatchRGBRenderRequest(items=items))
    alone = [client.render_rgb(request).image_bytes for request in asked]
    assert [item.result.image_bytes for item in reply.items] == alone and alone[0] != alone[1]


def test_refined_poses_blocks_left_out_and_a_model_of_the_uncut_drive(drive, tmp_path):
    results = tmp_path / "results"
    shutil.copytree(drive, results)
    scene = read_scene(results / "way/scene.json")
    frames = tuple(
        dataclasses.replace(frame, ego_to_world=moved(frame.ego_to_world, [0.0, 0.5, 0.0])) for frame in scene.frames
    )
    write_scene(results / "way/scene_refined.json", dataclasses.replace(scene, frames=frames))
    blocks = read_blocks(results / "way/blocks.json")
    write_blocks(
        results / "way/blocks.json",
        dataclasses.replace(blocks, provenance={**PROVENANCE, "stages": {"refine_poses": {}}}),
    )
    shutil.copytree(results / "way.000/street", results / "way/street")
    write_json(results / "way/street/eval.json", {"protocol": {"left_out": ["way.001"]}, "provenance": PROVENANCE})
    request = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id="way")
    with served(results) as (_, client):
        assert [*client.get_available_scenes(EMPTY).scene_ids] == ["way", "way.000", "way.001"]
        (found,) = client.get_available_trajectories(request).available_trajectories
        stamp, pose = found.trajectory.poses[-1].timestamp_us, pose_of(found.trajectory.poses[-1].pose)
        with pytest.raises(grpc.RpcError, match="block 1 of way is not served, or left out"):
            client.render_rgb(image_request("way", (stamp, stamp), (pose, pose)))
    assert pose[1, 3] == pytest.approx(scene.frames[-1].ego_to_world[1, 3] + 0.5, abs=1e-3)


def test_a_block_that_is_not_served_says_so(drive, path):
    stamp, pose = path[-1]
    with served(drive / "way.000/street") as (_, client):
        assert [*client.get_available_scenes(EMPTY).scene_ids] == ["way", "way.000"]
        with pytest.raises(grpc.RpcError) as error:
            client.render_rgb(image_request("way", (stamp, stamp), (pose, pose)))
    assert error.value.code() == grpc.StatusCode.NOT_FOUND
    assert error.value.details() == "block 1 of way is not served, or left out: way.001"
