"""A finished workflow, replayed through the service, has the PSNR that the workflow measured in held-out images."""

import json

import cv2
import numpy as np
import pytest
from carla_driver_interface._proto import common_pb2, sensorsim_pb2
from helpers.served_drives import image_request, object_of, pose_of, served
from helpers.shared_runs import CAR

import drivesplat

pytestmark = pytest.mark.workflow


def test_held_out_images_are_those_of_the_workflow(finished_run):
    results = finished_run.folder / "results"
    drive = drivesplat.open(results / "0001/street", device="cpu")
    measured = json.loads((results / "0001/metrics.json").read_text())["methods"]["street"]
    scene, record = drive.scene, drive.record
    with served(results, max_loaded=1) as (_, client):
        assert [*client.get_available_scenes(common_pb2.Empty()).scene_ids] == [
            "0001/street", "0001/vanilla",
        ]  # fmt: skip
        request = sensorsim_pb2.AvailableCamerasRequest(scene_id="0001/street")
        (camera,) = client.get_available_cameras(request).available_cameras
        trajectory = sensorsim_pb2.AvailableTrajectoriesRequest(scene_id="0001/street")
        recorded = client.get_available_trajectories(trajectory).available_trajectories[0].trajectory.poses
        rigs = {pose.timestamp_us: pose_of(pose.pose) for pose in recorded}
        for group in ("interpolation", "extrapolation"):
            errors, figures = [], measured[group]
            assert len(record.splits[group])
            for index in record.splits[group]:
                stamp = int(record.timestamps[index])
                pose = rigs[stamp] @ pose_of(camera.rig_to_camera)
                at = np.array([scene.seconds(stamp)])
                (actor,) = drive.edited_actors
                there = actor.poses(at)[0]
                listed = [object_of(CAR, there, there)] if actor.present(at)[0] else []
                size = camera.intrinsics.resolution_w, camera.intrinsics.resolution_h
                shown = image_request("0001/street", (stamp, stamp), (pose, pose), listed, camera.intrinsics, size)
                image = client.image(shown) / 255.0
                file = finished_run.folder / record.image_paths[index]
                truth = cv2.imread(str(file))[..., ::-1] / 255.0
                errors.append(((image - truth) ** 2).mean())
            assert -10.0 * np.log10(np.mean(errors)) == pytest.approx(figures["all"]["psnr"], abs=0.2), group
