"""Images and LiDAR between key frames through the whole workflow, as users run it, one image missing."""

import pytest
from helpers.drives import World
from helpers.small_runs import BASE
from helpers.workflow_copy import WorkflowCopy

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("sweeps_workflow")]

MISSING = "sweeps/CAM_FRONT/0001__0010.jpg"


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> WorkflowCopy:
    """A drive of 8 key frames, all but key frame 0 used."""
    settings = {name: BASE[name] for name in ("methods", "holdout", "actors", "train")}
    copy = WorkflowCopy.make(
        tmp_path_factory.mktemp("sweeps"),
        World(key_frames=8, sweeps_between=5, lidar_between=4),
        datasets={"nuscenes": {"dataroot": "data", "scenes": ["0001"], "frames": {"0001": [1, 8]}}},
        sweeps=True,
        lidar_seed={"sweeps": True, "max_points": 500, "far_points": 100},
        extract={"on_missing": "warn"},
        **settings,
    )
    (copy.folder / "data" / MISSING).unlink()
    done = copy.run("results/0001/metrics.json")
    assert done.returncode == 0, done.stdout
    assert (
        f"image results/.data/nuscenes/{MISSING} is missing; left out" in done.stdout and "Traceback" not in done.stdout
    )
    return copy


def test_images_between_key_frames_are_trained_on_and_the_missing_one_is_counted(finished):
    """Seven key frames are used: 2 and 6 are held out, and of the images between key frames those within a quarter of
    a second of them are excluded: five around the one, two before the other (cameras fire 35 ms early)."""
    protocol = finished.read("results/0001/metrics.json")["protocol"]
    assert protocol["sweeps"] is True and protocol["key_frame_range"] == [1, 8]
    assert protocol["held_out_frames"] == {"interpolation": [2], "extrapolation": [6]}
    scene = finished.read("results/0001/scene.json")
    times = scene["key_frame_timestamps"]
    between = [frame["timestamp"] for frame in scene["frames"] if not frame["is_key_frame"]]
    near = [time for time in between if min(abs(time - times[i]) for i in (2, 6)) < 250_000]
    assert (len(between), len(near), len(scene["sweeps"])) == (29, 7, 31)
    assert protocol["train_images"] == 5 + len(between) - len(near)
    assert protocol["images_missing"] == 1 and protocol["lidar_missing"] == 0


def test_key_frames_alone_are_measured(finished):
    metrics = finished.read("results/0001/metrics.json")
    for method in metrics["methods"].values():
        for group in ("interpolation", "extrapolation"):
            assert method[group]["all"]["pixels"] == 96 * 54 and method[group]["all"]["psnr"] > 8.0
    for group in ("interpolation", "extrapolation"):
        near = metrics["drive"][group]["from_training_m"]
        assert near == pytest.approx(1.0), "at 4 m/s, a quarter of a second away"
