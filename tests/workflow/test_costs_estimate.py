"""An estimate before a run says what has been measured in its results folder, and what has not; time, and disk."""

import pytest
import yaml
from helpers import REPOSITORY
from helpers.workflow_copy import WorkflowCopy

from drivesplat.settings.config import load, merged
from drivesplat.settings.train import TrainSettings
from drivesplat.workflow.costs.estimate import (
    Expectations,
    Machine,
    PlannedJob,
    estimate,
    in_full,
    in_one_line,
    wall_seconds,
)
from drivesplat.workflow.costs.measured import Cost, JobId

DEFAULTS = yaml.safe_load((REPOSITORY / "config.yaml").read_text())


def expectations(*costs: Cost, **config) -> Expectations:
    return Expectations(load(merged(DEFAULTS, config)), costs)


def training(scene: str, method: str, seconds: float, iterations: int = TrainSettings().iterations) -> Cost:
    return Cost(JobId("train", scene, method), seconds, "benchmark", iterations=iterations)


def test_the_nearest_that_was_measured_counts():
    own = Cost(JobId("masks", "0061"), 7.0, "")
    peers = [Cost(JobId("masks", scene), seconds, "") for scene, seconds in (("0103", 3.0), ("0553", 5.0))]
    demo = Cost(JobId("masks", "demo"), 100.0, "")
    assert expectations(own, *peers, demo).of(JobId("masks", "0061")) == (7.0, {own.job})
    found = expectations(*peers, demo).of(JobId("masks", "0061"))
    assert found == (4.0, {JobId("masks", "0103"), JobId("masks", "0553")})
    assert expectations(demo).of(JobId("masks", "0061")) == (None, set()), "another dataset tells nothing"


def test_scenes_and_methods_share_cores_and_gpus():
    methods = [(scene, method) for scene in "abcd" for method in ("vanilla", "street")]
    work = [PlannedJob(JobId("train", *method), 8, True, seconds=100.0) for method in methods]
    work += [PlannedJob(JobId("masks", scene), 1, False, seconds=10.0) for scene in "abcd"]
    assert wall_seconds(work, Machine(1, 1)) == 840.0
    assert wall_seconds(work, Machine(4, 8)) == 810.0, "a training takes all four"
    assert wall_seconds(work, Machine(64, 1)) == 800.0
    assert wall_seconds(work, Machine(64, 4)) == 200.0
    assert wall_seconds(work, Machine(64, 8)) == 110.0, "a training waits for its scene's masks"
    assert wall_seconds([], Machine(1, 1)) == 0.0


def test_an_estimate_says_how_it_knows_and_what_is_not_known_yet(tmp_path):
    planned = [PlannedJob(JobId("train", "0103", "vanilla"), 8, True), PlannedJob(JobId("masks", "0103"), 1, False)]
    unknown = estimate(planned, expectations(), Machine(4, 2), tmp_path)
    rough = (
        "2 jobs, very roughly 62 s on 4 cores and 2 GPUs (by other machines: no such job has run here before), disk "
        "use not known yet ("
    )
    assert rough in in_one_line(unknown), "7,000 iterations of 6 ms on a GPU after masks, 10 s of each job beside them"
    assert in_full(unknown).count("1 x not known yet") == 2
    on_cpu = estimate([PlannedJob(planned[0].job, 1, False)], expectations(), Machine(1, 1), tmp_path)
    assert on_cpu.rough_seconds == 10.0 + 7000 * 0.15
    half = estimate(planned, expectations(training("0061", "vanilla", 600.0)), Machine(1, 1), tmp_path)
    assert half.seconds == 600.0 and "about 10 min on 1 core (from 1 measured job)" in in_one_line(half)
    assert " without 1 job whose time is not known yet, very roughly 10 min in all, " in in_one_line(half)
    measured = [training("0061", "vanilla", 600.0), Cost(JobId("masks", "0061"), 60.0, "")]
    line = in_one_line(estimate(planned, expectations(*measured), Machine(1, 1), tmp_path))
    assert line.startswith("2 jobs, about 11 min on 1 core (from 2 measured jobs), ") and "GB free" in line
    assert in_one_line(estimate([], expectations(), Machine(1, 1), tmp_path)) == "nothing is to be run"


def test_disk_is_what_the_same_jobs_left_for_other_scenes(tmp_path):
    for scene, size in (("0103", 1000), ("0553", 3000)):
        folder = tmp_path / scene / "street"
        (folder / "tensorboard").mkdir(parents=True)
        (folder / "checkpoint.npz").write_bytes(bytes(size))
        (folder / "tensorboard/events").write_bytes(bytes(50))
    own = f"{tmp_path}/0061/street"
    planned = [
        PlannedJob(JobId("train", "0061", "street"), 1, True, (f"{own}/checkpoint.npz", f"{own}/train.json")),
        PlannedJob(JobId("film", "0061", "street", "original"), 1, True, (f"{own}/original.mp4",)),
        PlannedJob(JobId("train", "0103", "street"), 1, True, (f"{tmp_path}/0103/street/checkpoint.npz",)),
    ]
    known = expectations()
    assert [known.disk_bytes(one, tmp_path) for one in planned] == [2050.0, None, 0.0], "what is there is replaced"
    found = estimate(planned, known, Machine(1, 1), tmp_path)
    assert (found.disk, found.unknown_disk) == (2050.0, 1) and found.free_disk > 0
    assert estimate([], known, Machine(1, 1), tmp_path / "not/there/yet").free_disk > 0


@pytest.mark.slow
@pytest.mark.workflow
def test_a_run_is_estimated_before_and_accounted_for_after_it(tmp_path):
    copy = WorkflowCopy.make(tmp_path / "workflow", methods={"vanilla": {}})
    seed, costs = "results/0001/seed.ply", copy.folder / "results/costs.csv"
    asked = copy.run("estimate", seed)
    assert asked.returncode == 0 and "drivesplat: 3 jobs, very roughly " in asked.stdout, asked.stdout
    assert "x not known yet" in asked.stdout and not (copy.folder / seed).exists()
    everything = copy.run("estimate").stdout
    assert " train " in everything and " film " in everything and not (copy.folder / "results/0001").exists()
    done = copy.run(seed)
    assert done.returncode == 0 and "drivesplat: 3 jobs, very roughly " in done.stdout, done.stdout
    rows = [line.split(",")[:3] for line in costs.read_text().splitlines()[1:]]
    assert rows == [["0001", "", stage] for stage in ("extract", "lidar_seed", "own_car")]
    assert copy.planned(seed) == {}, "costs rerun nothing"
    costs.unlink()
    (copy.folder / "data").rename(copy.folder / "elsewhere")
    again = copy.run("costs")
    assert again.returncode == 0 and costs.exists() and "0001: " in again.stdout and "under 90" in again.stdout
    refused = copy.run("estimate", flags=("--no-hooks",))
    assert refused.returncode != 0 and "--no-hooks" in refused.stdout
    assert not (copy.folder / "results/0001/vanilla").exists()
