"""Poses of a synthetic drive refined from its images; and the stage among the others, as users run it."""

import functools
from pathlib import Path

import numpy as np
import pytest
from helpers.classed import classed
from helpers.demo_worlds import FRONT, pose_at
from helpers.drives import World
from helpers.workflow_copy import WorkflowCopy
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.preprocess.poses.refine import refine_poses
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Frame, Scene, Track, read_scene
from drivesplat.settings.refine_poses import RefinePosesJob
from drivesplat.settings.world import WorldSettings
from drivesplat.world.recorder import STREET_TO_GLOBAL, Recorder

KEY_FRAMES, KEY_FRAME_US = 6, 500_000
WIDTH = 400
JOB = RefinePosesJob.model_validate({"refine_poses": {}, "random_seed": 0})
SMALL = {"width": WIDTH, "key_frames": KEY_FRAMES, "samples_per_pixel": 1}


@functools.cache
def recorder_of(pose_noise: bool) -> Recorder:
    return Recorder(WorldSettings(pose_noise=pose_noise, **SMALL))


def filmed(recorder: Recorder, folder: Path) -> tuple[Scene, np.ndarray]:
    """The front camera's key frames and all boxes, as the tables would state them; the true ego_to_world (n, 4, 4)."""
    to_world = rigid(np.eye(3), -recorder.ego_to_global(0.0)[:3, 3])
    times = np.arange(KEY_FRAMES) * KEY_FRAME_US
    frames, truth = [], []
    for index, time in enumerate(times + FRONT.delay_us):
        image = recorder.image(FRONT, int(time))
        path = folder / f"{index}.png"
        Image.fromarray(image).save(path)
        ego = to_world @ recorder.ego_to_global(time * 1e-6)
        size = (image.shape[1], image.shape[0])
        frames.append(
            Frame("CAM_FRONT", int(time), str(path), *size, FRONT.intrinsics(WIDTH), ego @ FRONT.sensor_to_ego, ego,
                  True, index, str(index))
        )  # fmt: skip
        truth.append(to_world @ STREET_TO_GLOBAL @ recorder.ego_pose(time * 1e-6))
    tracks = [
        Track(
            thing.name, *classed(thing.category), np.array(thing.size), times, np.arange(KEY_FRAMES),
            np.stack([to_world @ recorder.box_to_global(thing, time * 1e-6) for time in times]),
            np.full(KEY_FRAMES, 4),
        )
        for thing in recorder.objects if thing.category
    ]  # fmt: skip
    scene = Scene(
        "demo", "demo", "v1.0-mini", "", np.zeros(3), times, tuple(frames), (), tuple(tracks), "nuscenes", 2.0
    )
    return scene, np.stack(truth)


def wobble(scene: Scene, truth: np.ndarray) -> np.ndarray:
    """Standard deviations (3,) in degrees of what is wrong with the rotations: beside what all images have in common,
    which no image shows."""
    errors = inverse(truth) @ np.stack([frame.ego_to_world for frame in scene.frames])
    return Rotation.from_matrix(errors[:, :3, :3]).as_rotvec(degrees=True).std(axis=0)


@pytest.mark.slow
def test_images_of_a_street_reduce_the_errors_of_noisy_poses(tmp_path):
    scene, truth = filmed(recorder_of(pose_noise=True), tmp_path)
    refined = refine_poses(scene, JOB, threads=2)
    assert refined.record["refined"], refined.record["kept_because"]
    assert refined.record["lens_warnings"] == []
    before, after = wobble(scene, truth), wobble(refined.scene, truth)
    assert (before[:2] > 0.2).all() and (after[:2] < 0.25 * before[:2]).all() and after[2] < 0.05
    trial = refined.record["trial"]
    assert trial["after_px"] < 0.75 * trial["before_px"]
    points = refined.points.points
    assert len(points) > 50 and set(refined.points.seen_by) == set(range(KEY_FRAMES))
    on_street = (points[:, 2] > -2.0) & (points[:, 2] < 23.0)  # the tallest buildings end there
    assert on_street.mean() > 0.9, "points are of the street, not of the sky"


@pytest.mark.parametrize("pose_noise", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_boxes_are_annotated_relative_to_the_ego_vehicle(pose_noise):
    """Under noisy poses they are still exact relative to the ego vehicle."""
    recorder = recorder_of(pose_noise)
    for thing in (thing for thing in recorder.objects if thing.category):
        for seconds in (0.0, 1.3):
            on_street = pose_at(thing, seconds) @ rigid(np.eye(3), np.array([0.0, 0.0, thing.size[2] / 2]))
            seen = inverse(recorder.ego_to_global(seconds)) @ recorder.box_to_global(thing, seconds)
            np.testing.assert_allclose(seen, inverse(recorder.ego_pose(seconds)) @ on_street, atol=1e-8)
            if not pose_noise:
                stated = recorder.box_to_global(thing, seconds)
                np.testing.assert_allclose(stated, STREET_TO_GLOBAL @ on_street, atol=1e-8)


REFINED = {"refine_poses": {"enabled": True, "rounds": 1}}
SEED = "results/0001/seed.ply"


@pytest.fixture(scope="module")
def seeded(tmp_path_factory) -> WorkflowCopy:
    """The workflow with refined poses, run until there is a seed. The tiny drive's few pixels refine nothing."""
    copy = WorkflowCopy.make(tmp_path_factory.mktemp("refined"), World(key_frames=6), **REFINED)
    done = copy.run(SEED)
    assert done.returncode == 0, done.stdout
    return copy


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.xdist_group("workflow")
class TestAmongTheOtherStages:
    def test_it_keeps_poses_that_it_cannot_improve_and_says_so(self, seeded):
        record = seeded.read("results/0001/poses.json")
        assert record["refined"] is False and "images see 30 triangulated points" in record["kept_because"]
        given, kept = (read_scene(seeded.folder / f"results/0001/{name}.json") for name in ("scene", "scene_refined"))
        for a, b in zip(given.frames, kept.frames, strict=True):
            np.testing.assert_array_equal(a.camera_to_world, b.camera_to_world)
        assert given.poses == kept.poses == "nuscenes"
        log = (seeded.folder / "results/logs/0001/refine_poses.log").read_text()
        assert "scene 0001: poses stay as they are" in log

    def test_its_results_say_where_they_come_from(self, seeded):
        for name in ("poses", "scene_refined"):
            stages = seeded.read(f"results/0001/{name}.json")["provenance"]["stages"]
            assert stages.keys() == {"extract", "own_car", "refine_poses"}
            assert stages["refine_poses"]["settings"]["refine_poses"]["rounds"] == 1

    def test_all_later_rules_take_its_scene(self, seeded):
        done = seeded.run("results/0001/metrics.json", "films", "looks", "exports", flags=("-n", "-p", "--forceall"))
        assert done.returncode == 0, done.stdout
        jobs = [block.partition("\n\n")[0] for block in done.stdout.split("\nrule ")[1:]]
        takes_scene = {job.split(":")[0] for job in jobs if "results/0001/scene.json" in _inputs(job)}
        takes_refined = {job.split(":")[0] for job in jobs if "results/0001/scene_refined.json" in _inputs(job)}
        assert takes_scene == {"own_car", "refine_poses"}
        assert {"lidar_seed", "parser", "masks", "evaluate", "film", "ghost_panel", "remove_actor", "tracks", "export",
                "export_usd", "export_viewer"} <= takes_refined  # fmt: skip

    @pytest.mark.parametrize(
        ("setting", "expected"),
        [
            ({"refine_poses": {"enabled": True, "rounds": 2}}, {"refine_poses": 1, "lidar_seed": 1}),
            ({"refine_poses": {"enabled": False, "rounds": 7}}, {"lidar_seed": 1}),
            ({"lidar_seed": {"max_points": 500, "far_points": 100, "triangulated": False}}, {"lidar_seed": 1}),
        ],
    )  # fmt: skip
    def test_a_changed_setting_reruns_it_and_what_depends_on_it(self, seeded, setting, expected):
        other = WorkflowCopy(seeded.folder, {**seeded.config, **setting})
        other.write_config()
        try:
            assert other.planned(SEED) == expected
        finally:
            seeded.write_config()


def _inputs(job: str) -> str:
    return next((line for line in job.splitlines() if line.strip().startswith("input:")), "")
