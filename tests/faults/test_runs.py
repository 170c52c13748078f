"""What goes wrong, and what the user may count on, each fault in one line: through Snakemake, or by its plan alone."""

import fcntl
import itertools
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

import pytest
from helpers.drives import World
from helpers.killed_runs import only_complaint, refusal_by_plan
from helpers.shared_runs import EDITS, TWO_METHODS, VANILLA
from helpers.workflow_copy import REPOSITORY, TINY_TRAINING, WorkflowCopy, complaints

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("faults")]


@pytest.fixture(scope="module")
def untouched(tmp_path_factory) -> WorkflowCopy:
    """For copies."""
    return WorkflowCopy.make(tmp_path_factory.mktemp("untouched") / "workflow", methods=VANILLA)


@pytest.fixture
def copy(untouched, tmp_path) -> WorkflowCopy:
    return untouched.again(tmp_path / "workflow")


def with_edits(copy: WorkflowCopy, text: str) -> WorkflowCopy:
    """With a second method, which knows actors, and this edits file for its scene."""
    copy.config["methods"] = TWO_METHODS
    copy.config["datasets"]["nuscenes"]["edits"] = {"0001": "edits.yaml"}
    copy.write_config()
    (copy.folder / "edits.yaml").write_text(text)
    return copy


MISTYPED = {
    "trian": {"iterations": 3},
    "train": {"iteration": 3, "iterations": -5},
    "sky": "blue",
    "holdout": {"every_nth": 4, "offset": 5},
}


def test_a_mistyped_key_or_value_stops_before_any_job(copy):
    """All of them are in one line; tests/settings/test_config.py has each by itself."""
    copy.config |= MISTYPED
    copy.write_config()
    line = only_complaint(copy.run())
    words = ["trian", "spelling", "train.iteration'", "3", "train.iterations", "-5", "greater than or equal to 1"]
    words += ["sky", "'blue'", "'none', 'mask' or 'cubemap'", "holdout", "offset", "every_nth (4)"]
    assert all(word in line for word in words), line
    assert not (copy.folder / "results").exists()


def test_an_unknown_scene_stops_before_any_job_and_lists_those_there_are(copy):
    line = only_complaint(copy.run("results/9999/metrics.json"))
    assert "9999" in line and "0001" in line
    assert not (copy.folder / "results").exists()


@pytest.mark.parametrize(
    ("target", "words"),
    [
        ("vanila/train.json", ["vanila", "vanilla"]),
        ("vanilla/nowhere.mp4", ["'nowhere'", "original, lateral_2m", "render.trajectories"]),
        ("vanilla/edits/stop.mp4", ["'vanilla' knows no actors", "those do: street"]),
        ("street/edits/halt.mp4", ["no edit called 'halt'", "there are: gone, stop", "datasets.<name>.edits"]),
    ],
)
def test_an_unknown_target_is_refused_with_those_there_are(copy, target, words):
    line = refusal_by_plan(with_edits(copy, EDITS), f"results/0001/{target}")
    assert all(word in line for word in words), line


@pytest.mark.parametrize(
    ("broken", "words"),
    [
        (EDITS.replace("at: 2", "at: soon"), ["edit 'stop', step 2 (stop)", "'at' is 'soon'"]),
        (EDITS.replace("- remove", "- vanish"), ["edit 'gone', step 1", "no step 'vanish'"]),
        (EDITS.replace("edits:", "edits"), ["not YAML"]),
        (None, ["cannot be read"]),
    ],
    ids=["a value", "a step", "no YAML", "no file"],
)
def test_a_broken_edits_file_stops_before_any_job(copy, broken, words):
    with_edits(copy, broken or "")
    if broken is None:
        (copy.folder / "edits.yaml").unlink()
    line = refusal_by_plan(copy)
    assert all(word in line for word in ["edits.yaml", *words]), line


@pytest.mark.parametrize(
    ("dataset", "words"),
    [
        ({"dataroot": "elsewhere"}, ["v1.0-mini", "elsewhere", "nuscenes.org", "dataroot"]),
        ({"dataroot": "empty"}, ["v1.0-mini", "empty", "nuscenes.org"]),
        ({"dataroot": "data", "version": "v1.0-trainval"}, ["v1.0-trainval", "data", "v1.0-mini", "version"]),
    ],
)
def test_a_missing_dataset_is_reported_in_one_message(copy, dataset, words):
    (copy.folder / "empty").mkdir()
    copy.config["datasets"] = {"nuscenes": {"scenes": ["0001"], **dataset}}
    line = refusal_by_plan(copy, "results/0001/metrics.json")
    assert all(word in line for word in words), line


def test_missing_tables_are_named(copy):
    (copy.folder / "data/v1.0-mini/ego_pose.json").unlink()
    assert "ego_pose.json" in only_complaint(copy.run("results/0001/scene.json"))


LOOKS = ("parts.mp4", "ghost_panel.png", "with_car.png", "splat.ply", "parts/parts.json", "scene.usdz", "viewer.html")


@pytest.mark.slow
def test_a_scene_without_vehicles_gets_nulls(tmp_path):
    """By a method with actors, too, whose parts are then filmed with an empty third picture."""
    training = TINY_TRAINING | {"iterations": 20}
    copy = WorkflowCopy.make(tmp_path / "workflow", World(things=[]), methods=TWO_METHODS, train=training)
    looks = {"vanilla": ("ghost_panel.png", "with_car.png"), "street": LOOKS}
    done = copy.run(
        "results/0001/metrics.json", *(f"results/0001/{method}/{name}" for method in looks for name in looks[method])
    )
    assert done.returncode == 0, done.stdout
    assert "NaN" not in (copy.folder / "results/0001/metrics.json").read_text()
    for method, metrics in copy.read("results/0001/metrics.json")["methods"].items():
        result, folder = metrics["extrapolation"], copy.folder / f"results/0001/{method}"
        assert result["vehicle"] is None and result["moving_vehicle"] is None and result["gap_db"] is None
        assert result["static"]["psnr"] == result["all"]["psnr"]
        for name in ("ghost_panel", "removal"):
            figures = copy.read(f"results/0001/{method}/{name}.json")
            assert figures["subject"] is figures["ghosts"] is None and "no moving vehicle" in figures["why_null"]
            assert "NaN" not in (folder / f"{name}.json").read_text()
        assert (folder / "with_car.png").read_bytes() == (folder / "without_car.png").read_bytes()


@pytest.fixture(scope="module")
def trained(finished_run, tmp_path_factory) -> WorkflowCopy:
    """Two finished trainings without what is made from them, to be looked at."""
    copy = finished_run.again(tmp_path_factory.mktemp("trained") / "workflow")
    for method in TWO_METHODS:
        for path in (copy.folder / "results/0001" / method).iterdir():
            if path.name not in ("train.json", "checkpoint.npz", "tensorboard", ".digests"):
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        for path in (copy.folder / "results/0001" / method / ".digests").iterdir():
            if path.stem not in ("train.json", "checkpoint.npz"):
                path.unlink()
    trained = [f"results/0001/{method}/train.json" for method in TWO_METHODS]
    assert copy.planned(*trained) == {}, "and the plan has written its tables for the copied data"
    return copy


@contextmanager
def altered(copy: WorkflowCopy, script: str, change: Callable[[str], str]) -> Iterator[None]:
    """One of the workflow's scripts, changed for a while."""
    path = copy.folder / f"workflow_scripts/{script}.py"
    whole = path.read_text()
    path.write_text(change(whole))
    try:
        yield
    finally:
        path.write_text(whole)


LOOK_SCRIPTS = {
    "film": "vanilla/original.mp4",
    "film_parts": "street/parts.mp4",
    "compare": "compare.mp4",
    "quad": "street/quad/gone.mp4",
    "edit": "street/edits/gone.mp4",
    "ghost_panel": "vanilla/ghost_panel.png",
    "remove_actor": "vanilla/with_car.png",
    "export": "vanilla/splat.ply",
    "export_usd": "vanilla/scene.usdz",
    "export_viewer": "vanilla/viewer.html",
    "export_colmap": "vanilla/colmap/points3D.txt",
    "export_alpasim": "vanilla/scene.alpasim.usdz",
}
"""Scripts, and a file of each that it cannot write."""


@pytest.mark.slow
def test_a_full_disk_stops_looks_and_each_names_its_file(trained):
    """A limit on the size of the job's files stands in for a disk without room: the same write fails the same way.
    Python, which before 3.13 keeps half a file of bytecode then, is to write none."""
    folder = trained.folder / "results/0001"
    assert trained.run("results/0001/vanilla/far.npz").returncode == 0  # the exports read it
    before = {file for file in folder.rglob("*") if file.is_file()}
    limit = "import resource\nimport sys\n\nsys.dont_write_bytecode = True\n"
    limit += f"resource.setrlimit(resource.RLIMIT_FSIZE, ({LARGEST_FILE}, {LARGEST_FILE}))\n"
    with ExitStack() as changed:
        for script in LOOK_SCRIPTS:
            changed.enter_context(altered(trained, script, lambda whole: limit + whole))
        done = trained.run(*(f"results/0001/{name}" for name in LOOK_SCRIPTS.values()), flags=("--keep-going",))
    assert done.returncode != 0 and "Traceback" not in done.stdout, done.stdout
    lines = complaints(done.stdout)
    for name in LOOK_SCRIPTS.values():
        (line,) = (line for line in lines if f"results/0001/{name}: " in line)
        assert "a bug" not in line
    assert len(lines) == len(LOOK_SCRIPTS), lines
    assert {file for file in folder.rglob("*") if file.is_file()} <= before
    assert not any((folder / name).exists() for name in LOOK_SCRIPTS.values())


LARGEST_FILE = 2500
"""Bytes: less than any of these files has, more than a log takes."""


def test_a_results_folder_that_cannot_be_made_is_named(trained, tmp_path):
    (tmp_path / "results").write_text("a file")
    folder = f"{tmp_path}/results/in"
    line = only_complaint(trained.run(f"{folder}/0001/scene.json", flags=("--config", f"results_dir={folder}")))
    assert line.startswith(f"drivesplat: {folder}/: cannot be written (") and "results_dir" in line


READ_ONLY = 'mount --bind results results && mount -o remount,bind,ro results && exec "$@"'


def test_a_results_folder_on_a_read_only_disk_is_named(trained):
    under = ("unshare", "--map-root-user", "--mount", "sh", "-c", READ_ONLY, "sh")
    if shutil.which("unshare") is None or subprocess.run([*under, "true"], cwd=trained.folder).returncode:
        pytest.skip("only where users may mount what others do not see")
    line = only_complaint(trained.run("results/0001/vanilla/scene.usdz", under=under))
    assert line.startswith("drivesplat: results/: cannot be written (Read-only file system); fix its permissions")


OUT_OF_MEMORY = """\
import torch
from drivesplat.training.loop import Trainer


def training_step(self, shown=True):
    raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB")


Trainer.training_step = training_step
"""


def test_a_training_out_of_gpu_memory_says_what_lowers_the_need_and_is_not_tried_again(trained):
    """The peak is that of the GPU itself in tests/test_gpu.py."""
    changed = trained.set_to(methods={"large": {}})
    with changed, altered(trained, "train", lambda whole: OUT_OF_MEMORY + whole):
        done = trained.run("results/0001/large/train.json")
    line = only_complaint(done)
    assert re.search(r"out of GPU memory with \d[\d,]* Gaussians \(peak 0\.0 GB\): lower train\.cap_max", line), line
    assert len(re.findall(r"^(?:local)?rule train:$", done.stdout, re.M)) == done.stdout.count(f"{line}\n") == 1
    assert not list((trained.folder / "results/0001/large").glob("*.*"))


@pytest.mark.parametrize("profile", ["default", "slurm"])
def test_no_profile_tries_failed_jobs_again(profile):
    text = (REPOSITORY / f"profiles/{profile}/config.yaml").read_text()
    rules = "".join(path.read_text() for path in (REPOSITORY / "rules").glob("*.smk"))
    assert not re.search(r"restart-times|retries", text + rules)


def test_without_network_lpips_is_null_with_the_reason_and_nothing_else_is(trained):
    url = "http://127.0.0.1:9/alexnet.pth"
    with trained.set_to(lpips={"enabled": True, "url": url}):
        done = trained.run("results/0001/vanilla/eval.json")
    assert done.returncode == 0, done.stdout
    assert f"LPIPS will be null: the AlexNet backbone could not be fetched from {url}" in done.stdout
    result = trained.read("results/0001/vanilla/eval.json")["result"]
    assert url in result["lpips_unavailable"] and "put the file at" in result["lpips_unavailable"]
    figures = result["extrapolation"]["all"]
    assert figures["lpips"] is None and figures["psnr"] > 0 and figures["ssim"] > 0


TRAINING_THAT_SLEEPS = """\
import json, os, time
from pathlib import Path
from drivesplat.workflow.job import job

with job(snakemake) as current:
    current.device()
    began = time.time()
    time.sleep(0.4)
    seen = {"gpu": os.environ["CUDA_VISIBLE_DEVICES"], "began": began, "ended": time.time()}
    Path(current.output.checkpoint).write_text("")
    Path(current.output.summary).write_text(json.dumps(seen))
"""


@pytest.mark.parametrize("gpus", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_there_are_never_more_gpu_jobs_than_gpus_and_each_sees_its_own(trained, gpus):
    """However many cores there are. None waits for a GPU, since none is started before one is free."""
    names = [f"GPU-{os.getpid()}-{number}" for number in range(gpus)]
    methods = [f"on{gpus}gpus{number}" for number in range(gpus + 2)]
    targets = [f"results/0001/{method}/train.json" for method in methods]
    changed = trained.set_to(methods={method: {} for method in methods}, device="any")
    with changed, altered(trained, "train", lambda _: TRAINING_THAT_SLEEPS):
        done = trained.run(*targets, cores=100, gpus=",".join(names))
    assert done.returncode == 0 and "waits for a GPU" not in done.stdout, done.stdout
    jobs = [trained.read(target) for target in targets]
    assert {job["gpu"] for job in jobs} == set(names)
    for name in names:
        spans = sorted((job["began"], job["ended"]) for job in jobs if job["gpu"] == name)
        assert all(ended <= began for (_, ended), (began, _) in itertools.pairwise(spans))


@pytest.mark.slow
def test_a_second_run_in_one_folder_is_refused(copy):
    results = copy.folder / "results"
    results.mkdir()
    with open(results / ".lock", "w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        line = only_complaint(copy.run("results/0001/scene.json"))
    assert "another run" in line
    assert copy.run("results/0001/scene.json", under=("env",)).returncode == 0, "in new interpreters, as users run it"
