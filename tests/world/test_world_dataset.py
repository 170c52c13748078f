"""The demo world as a dataset: nuscenes-devkit and the project's own reader take it for nuScenes."""

import numpy as np
import pytest
from helpers.drives import scene_at
from nuscenes.utils.data_classes import LidarPointCloud
from PIL import Image

CAMERAS = {"CAM_FRONT", "CAM_FRONT_RIGHT", "CAM_BACK_RIGHT", "CAM_BACK", "CAM_BACK_LEFT", "CAM_FRONT_LEFT"}
KEY_FRAMES = 6


def chain(tables, table: str, first: str) -> list[dict]:
    """The records of a table from a first one on, checked to be linked back as well."""
    records, before, token = [], "", first
    while token:
        records.append(tables.get(table, token))
        assert records[-1]["prev"] == before
        before, token = token, records[-1]["next"]
    return records


@pytest.fixture(scope="module")
def samples(demo_tables) -> list[dict]:
    return chain(demo_tables, "sample", demo_tables.scene[0]["first_sample_token"])


def test_key_frames_form_one_chain_at_2_hz_with_all_sensors_at_their_own_times(demo_tables, samples, capsys):
    scene = demo_tables.scene[0]
    demo_tables.list_scenes()
    assert "scene-demo, Synthetic street, day" in capsys.readouterr().out
    assert len(samples) == len(demo_tables.sample) == scene["nbr_samples"] == KEY_FRAMES
    assert samples[-1]["token"] == scene["last_sample_token"]
    assert set(np.diff([sample["timestamp"] for sample in samples])) == {500_000}
    for sample in samples:
        delays = {
            channel: demo_tables.get("sample_data", token)["timestamp"] - sample["timestamp"]
            for channel, token in sample["data"].items()
        }
        assert set(delays) == CAMERAS | {"LIDAR_TOP"} and len(set(delays.values())) == 7
        assert delays["LIDAR_TOP"] == 0 and delays["CAM_FRONT"] == -35_500
        assert all(-50_000 < delays[camera] < 0 for camera in CAMERAS)


def test_recordings_of_a_sensor_form_one_chain_and_the_front_camera_alone_records_at_12_hz(demo_tables, samples):
    for channel in sorted(CAMERAS | {"LIDAR_TOP"}):
        records = chain(demo_tables, "sample_data", samples[0]["data"][channel])
        assert len(records) == sum(data["channel"] == channel for data in demo_tables.sample_data)
        keys = [record["sample_token"] for record in records if record["is_key_frame"]]
        assert keys == [sample["token"] for sample in samples]
        steps, between = np.diff([record["timestamp"] for record in records]), 6 if channel == "CAM_FRONT" else 1
        assert np.abs(steps - 500_000 / between).max() <= 1.0
        assert [record["is_key_frame"] for record in records] == [i % between == 0 for i in range(len(records))]


def test_every_recording_has_its_file_and_an_ego_pose_of_its_time_far_from_zero(demo_tables, demo_root):
    for data in demo_tables.sample_data:
        pose = demo_tables.get("ego_pose", data["ego_pose_token"])
        assert pose["timestamp"] == data["timestamp"] and np.linalg.norm(pose["translation"][:2]) > 500.0
        path = demo_root / data["filename"]
        if data["sensor_modality"] == "camera":
            with Image.open(path) as image:
                assert image.size == (data["width"], data["height"]) == (160, 90)
        else:
            assert path.stat().st_size % 20 == 0
            cloud = LidarPointCloud.from_file(str(path)).points
            assert cloud.shape[0] == 4 and cloud.shape[1] > 15_000
            assert -2.0 < np.median(cloud[2]) < 0.0, "most returns come from the road below the sensor"


def test_annotations_of_an_object_form_one_chain_with_boxes_and_speeds(demo_tables, demo_root, samples):
    for instance in demo_tables.instance:
        rows = chain(demo_tables, "sample_annotation", instance["first_annotation_token"])
        assert len(rows) == instance["nbr_annotations"]
        assert rows[-1]["token"] == instance["last_annotation_token"]
        assert {row["instance_token"] for row in rows} == {instance["token"]}
        times = [demo_tables.get("sample", row["sample_token"])["timestamp"] for row in rows]
        assert times == sorted(set(times))
    path, boxes, intrinsics = demo_tables.get_sample_data(samples[0]["data"]["CAM_FRONT"])
    assert path.startswith(str(demo_root)) and intrinsics.shape == (3, 3)
    assert "vehicle.car" in {box.name for box in boxes} and all(box.center[2] > 0 for box in boxes)
    speeds = {}
    for token in samples[2]["anns"]:
        for attribute in demo_tables.get("sample_annotation", token)["attribute_tokens"]:
            name = demo_tables.get("attribute", attribute)["name"]
            speeds.setdefault(name, []).append(np.linalg.norm(demo_tables.box_velocity(token)[:2]))
    assert max(speeds["vehicle.parked"]) < 1e-9
    assert min(speeds["vehicle.moving"]) > 5.0 and max(speeds["vehicle.moving"]) < 14.0
    assert min(speeds["pedestrian.moving"]) > 0.5 and max(speeds["pedestrian.moving"]) < 2.0


def test_the_projects_reader_reads_it(demo_root):
    scene = scene_at(demo_root, dataset="demo", scene="demo", on_missing="stop")
    assert len(scene.frames) == 31 and len(scene.sweeps) == KEY_FRAMES and scene.missing_images == 0
    assert [frame.sample_index for frame in scene.frames if frame.is_key_frame] == list(range(KEY_FRAMES))
    assert np.linalg.norm(scene.frames[0].camera_to_world[:3, 3]) < 5.0, "the scene's own origin is where it starts"
    moving = {track.category for track in scene.tracks if np.ptp(track.object_to_world[:, 0, 3]) > 1.0}
    assert "vehicle.car" in moving
