"""MCAP files as rules: of the drive as rendered and of a run; nobody makes them unasked."""

import pytest
import yaml
from helpers.mcap_files import Recording, nanoseconds, pose_of
from helpers.workflow_copy import WorkflowCopy

pytestmark = pytest.mark.workflow
RUNS = {
    "brakes": {
        "policy": "pure_pursuit", "edit": "stop", "film_width": 64,
        "simulation": {"seconds": 0.4, "cameras": ["CAM_FRONT"], "width": 64, "validity": True},
    }
}  # fmt: skip
STREET = "results/0001/street"
FILES = [f"{STREET}/{at}drive.mcap" for at in ("", "runs/brakes/")]
IMAGES = "/CAM_FRONT/image_raw/compressed"


@pytest.fixture(scope="module")
def copy(finished_run, tmp_path_factory) -> WorkflowCopy:
    made = finished_run.again(tmp_path_factory.mktemp("mcap") / "workflow")
    (made.folder / "runs.yaml").write_text(yaml.safe_dump({"runs": RUNS}))
    made.config["runs"] = "runs.yaml"
    made.write_config()
    return made


def test_files_are_made_where_they_are_asked_for(copy):
    planned = copy.planned("mcap")
    assert planned["drive_mcap"] == 5 and planned["run_folder"] == 1 and planned["drive_folder"] == 4
    assert not {"drive_mcap", "run_folder", "drive_folder"} & set(copy.planned("all"))
    done = copy.run(*FILES)
    assert done.returncode == 0, done.stdout
    whole, run = (Recording.of(copy.folder / file) for file in FILES)
    scene = copy.read("results/0001/scene.json")
    stamps = sorted(1000 * frame["timestamp"] for frame in scene["frames"])
    assert [time for time, _ in whole.messages[IMAGES]] == stamps
    (episode,) = copy.read(f"{STREET}/runs/brakes.json")["episodes"]
    poses = [pose_of(message.pose.pose) for message in run.all("/odom")]
    assert len(poses) == len(episode["path"]) == len(run.all(IMAGES)) == 5
    for pose, row in zip(poses, episode["path"], strict=True):
        assert pose[:3, 3] == pytest.approx(row[1:4], abs=1e-3)
    first = nanoseconds(run.all(IMAGES)[0].header)
    assert first == stamps[0] and nanoseconds(run.all(IMAGES)[4].header) - first == 400_000_000
    assert b"street/drive_mcap" in (copy.folder / FILES[0]).read_bytes()  # its provenance
    assert not {"drive_mcap", "run_folder"} & set(copy.planned(*FILES))


def test_without_a_trajectory_of_the_recorded_path_there_is_no_file(copy):
    with copy.set_to(render={"trajectories": {"original": {"lateral": 1.0}}}):
        done = copy.run(f"{STREET}/drive.mcap", flags=("-n",))
    assert done.returncode and "add render: {trajectories: {original: {}}}" in done.stdout
