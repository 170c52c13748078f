"""An estimate before a run: by what jobs like it cost here, else by a machine that is known; time, and disk."""

from types import SimpleNamespace

import pytest
import yaml
from helpers import REPOSITORY
from helpers.workflow_copy import WorkflowCopy

from drivesplat.settings.config import load, merged
from drivesplat.workflow.costs.disk import Leaves, disk_need
from drivesplat.workflow.costs.estimate import Machine, PlannedJob, estimate, in_full, in_one_line, spelled
from drivesplat.workflow.costs.expected import SECONDS, START_SECONDS, Expectations, Work, wall_seconds
from drivesplat.workflow.costs.measured import Cost, Job
from drivesplat.workflow.costs.run_costs import planned_job
from drivesplat.workflow.costs.usual import gaussians_of, usual_bytes

DEFAULTS = yaml.safe_load((REPOSITORY / "config.yaml").read_text())


def expectations(*costs: Cost, **config) -> Expectations:
    return Expectations(load(merged(DEFAULTS, config)), costs)


def training(scene: str, method: str, seconds: float, iterations: int = 15000) -> Cost:
    return Cost(Job("train", scene, method), seconds, "benchmark", iterations=iterations)


def test_the_nearest_that_was_measured_counts():
    own, peers = (
        Cost(Job("masks", "0061"), 7.0, ""),
        [Cost(Job("masks", s), t, "") for s, t in (("0103", 3.0), ("0553", 5.0))],
    )
    demo = Cost(Job("masks", "demo"), 100.0, "")
    assert expectations(own, *peers, demo).of(Job("masks", "0061")).seconds == 7.0
    found = expectations(*peers, demo).of(Job("masks", "0061"))
    assert (found.seconds, found.measured) == (4.0, {Job("masks", "0103"), Job("masks", "0553")})
    found = expectations(demo).of(Job("masks", "0061"))
    assert (found.seconds, found.measured) == (SECONDS["masks"], frozenset()), "another dataset tells nothing"


def test_a_training_goes_with_its_iterations():
    measured = [training("0061", "vanilla", 100.0, 10000), training("0061", "street", 300.0, 15000)]
    known = expectations(*measured, train={"iterations": 30000})
    assert known.of(Job("train", "0103", "vanilla")).seconds == 300.0
    assert known.of(Job("train", "0103", "street")).seconds == 600.0
    more = expectations(measured[0], train={"iterations": 30000}).of(Job("train", "0103", "street"))
    assert not more.measured, "a method without parts that move tells nothing of one with them"
    unknown = expectations(train={"iterations": 30000})
    double = expectations(train={"iterations": 60000})
    for method, seconds in (("vanilla", 2 * 20.5), ("street", 2 * 37.5)):
        job = Job("train", "0103", method)
        assert unknown.of(job).seconds == pytest.approx(START_SECONDS + seconds, rel=0.05), "as on that machine"
        assert double.of(job).seconds - unknown.of(job).seconds == pytest.approx(seconds, rel=0.05)
    slow = expectations(train={"iterations": 30000}, device="cpu").of(Job("train", "0103", "street"))
    assert slow.seconds > 5 * unknown.of(Job("train", "0103", "street")).seconds


def test_a_synthetic_world_goes_with_its_images():
    worlds = {"large": {"width": 1600, "key_frames": 40, "sweeps": []}, "demo": {}}
    datasets = {
        name: {"dataroot": name, "scenes": [name], "batch": False, "world": world} for name, world in worlds.items()
    }
    seconds = {name: expectations(datasets=datasets).of(Job("demo_world", film=name)).seconds for name in worlds}
    assert seconds["demo"] == SECONDS["demo_world"]
    assert seconds["large"] / seconds["demo"] == pytest.approx(320 * 16 / 255)
    measured = expectations(Cost(Job("demo_world", film="demo"), 50.0, ""), datasets=datasets)
    assert measured.of(Job("demo_world", film="large")).seconds == pytest.approx(50.0 * 320 * 16 / 255)
    assert measured.of(Job("demo_world", film="demo")).seconds == 50.0
    gone = expectations(Cost(Job("demo_world", film="gone"), 50.0, ""), datasets=datasets)
    assert gone.of(Job("demo_world", film="demo")).seconds == SECONDS["demo_world"], "who knows how large it was"


def test_scenes_and_methods_share_cores_and_cards():
    work = [Work(Job("train", scene, m), 100.0, 8, True) for scene in "abcd" for m in ("vanilla", "street")]
    work += [Work(Job("masks", scene), 10.0, 1, False) for scene in "abcd"]
    assert wall_seconds(work, cores=1, gpus=1) == 840.0
    assert wall_seconds(work, cores=4, gpus=8) == 810.0, "a training takes all four"
    assert wall_seconds(work, cores=64, gpus=1) == 800.0
    assert wall_seconds(work, cores=64, gpus=4) == 200.0
    assert wall_seconds(work, cores=64, gpus=8) == 110.0, "a training waits for its scene's masks"
    assert wall_seconds([], cores=1, gpus=1) == 0.0


def test_an_estimate_says_how_it_knows(tmp_path):
    planned = [PlannedJob(Job("train", "0103", "vanilla"), 8, True), PlannedJob(Job("masks", "0103"), 1, False)]
    rough = estimate(planned, expectations(), Machine(4, 2), tmp_path)
    assert "no such job measured here yet: rough" in in_one_line(rough) and "H200" in in_full(rough)
    half = estimate(planned, expectations(training("0061", "vanilla", 600.0)), Machine(1, 1), tmp_path)
    assert half.seconds == 600.0 + SECONDS["masks"] and "from 1 measured job; 1 rough" in in_one_line(half)
    measured = [training("0061", "vanilla", 600.0), Cost(Job("masks", "0061"), 60.0, "")]
    line = in_one_line(estimate(planned, expectations(*measured), Machine(1, 1), tmp_path))
    assert line.startswith("2 jobs, about 11 min on 1 core (from 2 measured jobs), ") and "GB free" in line
    assert in_one_line(estimate([], expectations(), Machine(1, 1), tmp_path)) == "nothing is to be run"


def test_disk_is_what_the_same_jobs_left_for_other_scenes(tmp_path):
    for scene, size in (("0103", 1000), ("0553", 3000)):
        folder = tmp_path / scene / "street"
        (folder / "tensorboard").mkdir(parents=True)
        (folder / "checkpoint.pt").write_bytes(bytes(size))
        (folder / "tensorboard/events").write_bytes(bytes(50))
    jobs = [
        Leaves(
            Job("train", "0061", "street"),
            (f"{tmp_path}/0061/street/checkpoint.pt", f"{tmp_path}/0061/street/train.json"),
        ),
        Leaves(Job("film", "0061", "street", "original"), (f"{tmp_path}/0061/street/original.mp4",)),
        Leaves(Job("train", "0103", "street"), (f"{tmp_path}/0103/street/checkpoint.pt",)),
    ]
    found = disk_need(tmp_path, jobs, lambda scene: ["0103", "0553", "0655"], lambda job: 7e6)
    assert found.needed == 2050 + 7e6, "what is there already is replaced"
    assert found.rough == 1 and found.free > 0
    assert disk_need(tmp_path / "not/there/yet", [], lambda scene: [], lambda job: 0.0).free > 0


def test_what_nobody_has_measured_goes_with_its_settings():
    def megabytes(stage: str, scene: str = "0061", film: str = "", **config) -> float:
        return usual_bytes(load(merged(DEFAULTS, config)), Job(stage, scene, "street", film)) / 1e6

    fewer = {"train": {"cap_max": 500_000}}
    for stage, bytes_a_gaussian in (("train", 23 * 4), ("export", 2 * 26 * 4)):
        more = megabytes(stage) - megabytes(stage, **fewer)
        assert more == pytest.approx(bytes_a_gaussian * 1.0), "a million more Gaussians with harmonics of degree 1"
    degree_3 = {"train": {"gaussians": {"sh_degree": 3}}}
    assert megabytes("export", **degree_3) == pytest.approx(2 * 62 * 4 * 1.5), "62 numbers, as 3DGS's PLY has them"
    limits = {"export": {"usd_gaussians": 10_000, "viewer_gaussians": 10_000}}
    assert megabytes("export_usd", **limits) < 1.0 and megabytes("export_viewer", **limits) < 1.1
    assert megabytes("film", film="original", render={"fps": 15}) == pytest.approx(megabytes("film") / 2)
    assert megabytes("edit", film="stop", render={"edited_frames": True}) > 10 * megabytes("edit", film="stop")
    half = {"datasets": {"nuscenes": {"frames": {"0061": [0, 20]}}}}
    assert megabytes("film", **half) == pytest.approx(megabytes("film") * 19 / 39)
    assert megabytes("lidar_seed", lidar_seed={"max_points": 100_000, "far_points": 0}) == pytest.approx(2.0)


def test_gaussians_are_no_more_than_pixels_of_training_images_allow():
    narrow = load(merged(DEFAULTS, {"images": {"width": 640}}))
    assert gaussians_of(narrow, "0061", "vanilla") == 40 * 640 * 360 // 20
    assert gaussians_of(load(DEFAULTS), "0061", "vanilla") == 1_500_000
    assert gaussians_of(load(merged(DEFAULTS, {"train": {"pixels_per_gaussian": 0}})), "0061", "street") == 1_500_000
    assert gaussians_of(load(DEFAULTS), "demo", "street") == 40_000


def test_the_demo_is_foretold_as_what_its_run_left():
    """Megabytes of the files of a run of the demo."""
    left = {
        "demo_world": 24.0, "train": 5.5, "export": 8.5, "export_usd": 3.9, "export_viewer": 2.1, "film": 1.4,
        "edit": 1.45, "lidar_seed": 0.5, "parser": 0.5,
    }  # fmt: skip
    config = load(DEFAULTS)
    for stage, megabytes in left.items():
        job = Job(stage, film="demo") if stage == "demo_world" else Job(stage, "demo", "street", "original")
        assert 0.5 * megabytes < usual_bytes(config, job) / 1e6 < 2 * megabytes, stage


@pytest.mark.parametrize(("gpu", "on_gpu"), [(1, True), (0, False), (None, False)])
def test_on_processors_no_job_waits_for_a_card(gpu, on_gpu):
    resources = {} if gpu is None else {"gpu": gpu}
    job = SimpleNamespace(threads=2, resources=resources, output=["a.mp4"])
    assert planned_job(Job("film", "demo"), job) == PlannedJob(Job("film", "demo"), 2, on_gpu, ("a.mp4",))


@pytest.mark.parametrize(("seconds", "text"), [(45.2, "45 s"), (700.0, "12 min"), (11100.0, "3 h 5 min")])
def test_time_is_spelled_for_people(seconds, text):
    assert spelled(seconds) == text


@pytest.mark.workflow
def test_a_run_is_estimated_before_and_accounted_for_after_it(tmp_path):
    copy = WorkflowCopy.make(tmp_path / "workflow", methods={"vanilla": {}})
    seed, costs = "results/0001/seed.ply", copy.folder / "results/costs.csv"
    asked = copy.run("estimate", seed)
    assert asked.returncode == 0 and "drivesplat: 3 jobs, about " in asked.stdout, asked.stdout
    assert "no such job measured here yet: rough" in asked.stdout and not (copy.folder / seed).exists()
    everything = copy.run("estimate").stdout
    assert " train " in everything and " film " in everything and not (copy.folder / "results/0001").exists()
    done = copy.run(seed)
    assert done.returncode == 0 and "drivesplat: 3 jobs, about " in done.stdout, done.stdout
    rows = [line.split(",")[:3] for line in costs.read_text().splitlines()[1:]]
    assert rows == [["0001", "", stage] for stage in ("extract", "lidar_seed", "own_car")]
    assert copy.planned(seed) == {}, "costs rerun nothing"
    costs.unlink()
    (copy.folder / "data").rename(copy.folder / "elsewhere")
    again = copy.run("costs")
    assert again.returncode == 0 and costs.exists() and "0001: " in again.stdout and "under 90" in again.stdout
    refused = copy.run("estimate", flags=("--no-hooks",))
    assert (
        refused.returncode != 0
        and "--no-hooks" in refused.stdout
        and not (copy.folder / "results/0001/vanilla").exists()
    )
