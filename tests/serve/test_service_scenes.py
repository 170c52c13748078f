"""Which drives are served, under which names, and which are in memory."""

import shutil
import weakref
from pathlib import Path

import grpc
import numpy as np
import pytest
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from helpers.served_drives import CAMERA, image_request, pose_of, served

import drivesplat
from drivesplat.drive.packed_drive import packed_members, packed_scene_id
from drivesplat.errors import DeviceError, RequestError, ResultError
from drivesplat.export.alpasim import drive_files, scene_id
from drivesplat.export.alpasim_records import AlpasimScene
from drivesplat.io.aligned_zip import write_aligned_zip
from drivesplat.serve import scenes
from drivesplat.serve.scenes import LoadedDrives, find_sources

EMPTY = common_pb2.Empty()


def test_scenes_are_named_by_their_folders(results):
    both = {"0001/street": results / "0001/street", "0001/street_lidar": results / "0001/street_lidar"}
    expected = {**both, "0002": results / "0002/street"}
    assert {name: source.folder for name, source in find_sources([results]).items()} == expected
    assert [*find_sources([results / "0001"])] == [*both]
    assert [*find_sources([results / "0001/street"])] == ["0001"]
    assert [*find_sources([results, results / "0001/street"])] == [*expected], "a folder that is named twice"


def test_what_is_no_trained_drive_says_so(results, tmp_path):
    shutil.copytree(results / "0002", tmp_path / "results/0002")
    for paths, words in (
        ([tmp_path / "none"], "no checkpoint.npz"), ([results, tmp_path / "results"], "0002"),
    ):  # fmt: skip
        with pytest.raises(RequestError, match=words):
            find_sources(paths)


@pytest.fixture
def archive(results, tmp_path, monkeypatch) -> Path:
    """The drive of results/0002/street as scenes/scene.alpasim.usdz, without what other programs read of it."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    drive = drivesplat.open(results / "0002/street", device="cpu")
    members = packed_members(drive.folder, drive.scene.name, drive_files(drive))
    path = tmp_path / "scenes/scene.alpasim.usdz"
    path.parent.mkdir()
    write_aligned_zip(path, {"metadata.yaml": f"scene_id: {scene_id(drive)}\n".encode(), **members})
    return path


def test_a_scene_for_alpasim_is_served_by_its_id_without_the_folder_of_results(results, street, archive):
    own, stamp = packed_scene_id(archive), street.scene.frames[1].timestamp
    seen = (stamp, stamp), (street.camera_to_world(CAMERA, street.scene.seconds(stamp)),) * 2
    with served(results / "0002") as (_, client):
        expected = client.render_rgb(image_request("0002", *seen)).image_bytes
    for path in (archive, archive.parent):
        with served(path, max_loaded=1) as (running, client):
            assert [*client.get_available_scenes(EMPTY).scene_ids] == ["0002", own]
            assert client.render_rgb(image_request(own, *seen)).image_bytes == expected
            batch = sensorsim_pb2.BatchRGBRenderRequest()
            for name in ("0002", own, "0002/street"):
                batch.items.add(request=image_request(name, *seen))
            images = [item.result.image_bytes for item in client.batch_render_rgb(batch).items]
            assert images == 3 * [expected], "one scene by three ids, where one scene may be loaded"
            assert [entry.scene_id for entry in client.get_loaded_scenes(EMPTY).scenes] == [own]
            loaded = running.service.figures.registry.get_sample_value("drivesplat_loaded_scenes")
            assert loaded == 1.0


def test_a_folder_of_results_knows_the_id_of_the_scene_that_it_exported(results, archive, tmp_path):
    folder = tmp_path / "results/0002/street"
    shutil.copytree(results / "0002", folder.parent)
    shutil.copy(archive, folder)
    assert find_sources([folder])["0002"].archive_id == packed_scene_id(archive)
    shutil.copy(results / "0001/street_lidar/checkpoint.npz", folder)
    assert find_sources([folder])["0002"].archive_id is None, "another training"


@pytest.mark.parametrize("damage", [b"", b"PK", None])
def test_a_damaged_scene_says_so(archive, damage):
    archive.write_bytes(archive.read_bytes()[:-30] if damage is None else damage)
    with pytest.raises(ResultError, match=r"scene\.alpasim\.usdz: .*; export it again"):
        find_sources([archive])


def test_a_scene_of_one_method_is_also_known_by_its_full_name(client):
    cameras = [
        client.get_available_cameras(sensorsim_pb2.AvailableCamerasRequest(scene_id=name))
        for name in ("0002", "0002/street")
    ]
    assert cameras[0] == cameras[1]


def test_a_client_is_told_what_there_is(client, street):
    assert [*client.get_available_scenes(EMPTY).scene_ids] == ["0001/street", "0001/street_lidar", "0002"]
    version = client.get_version(EMPTY)
    assert version.version_id.startswith("drivesplat ") and version.grpc_api_version.minor == 54
    (camera,) = client.get_available_cameras(
        sensorsim_pb2.AvailableCamerasRequest(scene_id="0001/street")
    ).available_cameras  # fmt: skip
    own, spec = street.camera(CAMERA), camera.intrinsics
    assert (camera.logical_id, spec.logical_id, spec.shutter_type) == (CAMERA, CAMERA, sensorsim_pb2.GLOBAL)
    assert (spec.resolution_w, spec.resolution_h) == (own.width, own.height)
    lens = spec.opencv_pinhole_param
    assert [lens.focal_length_x, lens.focal_length_y] == [own.K[0, 0], own.K[1, 1]]
    assert [lens.principal_point_x, lens.principal_point_y] == [*own.K[:2, 2]]
    np.testing.assert_allclose(pose_of(camera.rig_to_camera), own.camera_to_ego, atol=1e-6)


def test_the_recorded_path_is_that_of_the_vehicle(client, street):
    request = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id="0001/street")
    (found,) = client.get_available_trajectories(request).available_trajectories
    stamps = [pose.timestamp_us for pose in found.trajectory.poses]
    assert stamps == sorted({frame.timestamp for frame in street.scene.frames if frame.camera == CAMERA})
    for pose in found.trajectory.poses[:: len(stamps) // 3]:
        expected = street.ego_to_world(street.scene.seconds(pose.timestamp_us))
        np.testing.assert_allclose(pose_of(pose.pose), expected, atol=1e-5)


def test_scenes_are_loaded_on_demand_and_the_one_used_longest_ago_is_dropped(results, street):
    stamp = street.scene.frames[0].timestamp
    names = ["0001/street", "0001/street_lidar", "0002"]
    requests = {name: image_request(name, (stamp, stamp), (np.eye(4), np.eye(4))) for name in names}

    def loaded(client) -> list[str]:
        reply = client.get_loaded_scenes(EMPTY)
        assert reply.loaded_instance_capacity == 2
        assert all(entry.loaded_instance_count == 1 for entry in reply.scenes)
        return [entry.scene_id for entry in reply.scenes]

    with served(results, max_loaded=2) as (running, client):
        assert loaded(client) == []
        first = client.render_rgb(requests[names[0]]).image_bytes
        kept = weakref.ref(running.service._drives._loaded[names[0]].drive.model)
        client.render_rgb(requests[names[1]])
        assert loaded(client) == names[:2]
        client.render_rgb(requests[names[0]])
        client.render_rgb(requests[names[2]])
        assert loaded(client) == [names[0], names[2]] and kept() is not None
        client.render_rgb(requests[names[1]])
        assert loaded(client) == [names[2], names[1]] and kept() is None, "its memory is free"
        assert client.render_rgb(requests[names[0]]).image_bytes == first
        batch = sensorsim_pb2.BatchRGBRenderRequest()
        for request in requests.values():
            batch.items.add(request=request)
        with pytest.raises(grpc.RpcError, match="3 scenes") as raised:
            client.batch_render_rgb(batch)
        assert raised.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED


def test_where_memory_is_exhausted_a_scene_is_loaded_alone(results, monkeypatch):
    drives = LoadedDrives(find_sources([results]), "cpu", 3)
    drives.get("0001/street")
    opened, open_drive = [], scenes.open_drive

    def full(folder, device):
        opened.append(folder)
        if len(opened) == 1 or opened.count(folder) == 3:
            raise DeviceError("out of GPU memory")
        return open_drive(folder, device)

    monkeypatch.setattr(scenes, "open_drive", full)
    drives.get("0002")
    assert drives.names == ["0002"] and len(opened) == 2
    monkeypatch.setattr(scenes, "open_drive", lambda *_: (_ for _ in ()).throw(DeviceError("out of GPU memory")))
    with pytest.raises(scenes.ServiceError, match="out of GPU memory") as raised:
        drives.get("0001/street")
    assert raised.value.code == "RESOURCE_EXHAUSTED" and drives.names == []


class _Model:
    """Something in memory."""


def test_a_drive_that_was_opened_in_part_makes_place_for_the_second_attempt(results, monkeypatch):
    drives, open_drive, partly = LoadedDrives(find_sources([results]), "cpu", 3), scenes.open_drive, []
    drives.get("0001/street")

    def full(folder, device):
        if partly:
            assert partly[0]() is None, "its memory is free"
            return open_drive(folder, device)
        model = _Model()
        partly.append(weakref.ref(model))
        raise DeviceError("out of GPU memory")

    monkeypatch.setattr(scenes, "open_drive", full)
    assert drives.get("0002").drive.cameras and len(partly) == 1


def test_loaded_scenes_can_be_named_while_another_thread_loads_one(results):
    class Offered(dict):
        """Drives, of which another is loaded whenever one is looked up."""

        def __getitem__(self, name):
            drives._loaded.setdefault("0002", None)
            return super().__getitem__(name)

    drives = LoadedDrives(find_sources([results]), "cpu", 3)
    drives.offered = Offered(drives.offered)
    drives._loaded["0001/street"] = None
    assert drives.names == ["0001/street"] and drives.names == ["0001/street", "0002"]


def test_a_damaged_result_is_a_failed_precondition_and_others_go_on(results, street, tmp_path):
    shutil.copytree(results, tmp_path / "results")
    (tmp_path / "results/0001/street/checkpoint.npz").write_bytes(b"no checkpoint")
    stamp = street.scene.frames[0].timestamp
    with served(tmp_path / "results") as (_, client):
        with pytest.raises(grpc.RpcError, match=r"checkpoint\.npz") as raised:
            client.render_rgb(image_request("0001/street", (stamp, stamp), (np.eye(4), np.eye(4))))
        assert raised.value.code() == grpc.StatusCode.FAILED_PRECONDITION
        assert client.render_rgb(image_request("0002", (stamp, stamp), (np.eye(4), np.eye(4)))).image_bytes


@pytest.mark.parametrize("scene", ["0001/street", "0002"])
def test_all_images_that_a_scene_for_alpasim_lists_are_in_range(client, results, scene):
    """The exposure of the first image begins before it, and that of the last one ends after it."""
    drive = drivesplat.open(find_sources([results])[scene].folder, device="cpu")
    request = sensorsim_pb2.AvailableCamerasRequest(scene_id=scene)
    (camera,) = client.get_available_cameras(request).available_cameras
    frames = AlpasimScene.of(drive, "x").images[CAMERA]
    assert drive.scene.seconds(frames[0][0]) < 0.0 and drive.scene.seconds(frames[-1][1]) > drive.duration
    for frame, stamp in ((frames[0], 0.0), (frames[-1], drive.duration)):
        pose = drive.camera_to_world(CAMERA, stamp)
        for start, end in (frame, (frame[0], frame[0] + 2000), (frame[1], frame[1])):
            asked = image_request(scene, (start, end), (pose, pose), spec=camera.intrinsics)
            assert client.render_rgb(asked).image_bytes
    before = image_request(scene, (frames[0][0],) * 2, (pose, pose))
    same = image_request(scene, (drive.scene.frames[0].timestamp,) * 2, (pose, pose))
    assert client.render_rgb(before) == client.render_rgb(same), "the world of the first image"
