"""Files altered after their rule wrote them, over a finished run: every reader refuses them, and its advice works."""

import json
import re
import runpy
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.workflow_copy import WorkflowCopy

pytestmark = [pytest.mark.workflow, pytest.mark.xdist_group("altered_files")]

FLIPS, OF_MEMBERS = 100, 40
"""Altered files at least, and those of them at random, mostly masks, images and sweeps."""
READS_DATASET = re.compile(r"dataset=\((.*?)\)")


class NamedFiles(list):
    """The inputs or outputs of a rule, as Snakemake gives them to its script."""

    def __init__(self, files: list[str], names: list[str]):
        super().__init__(files)
        self.__dict__.update(zip(names, files, strict=True))


@pytest.fixture(scope="module")
def finished(finished_run, tmp_path_factory) -> WorkflowCopy:
    """A copy of the finished run, whose files a test alters and restores."""
    return finished_run.again(tmp_path_factory.mktemp("altered") / "workflow")


def records(copy: WorkflowCopy) -> dict[str, dict]:
    """The records of digests, by the output they are about; of the scene and the method with actors, so that a rule has
    one job. The report takes altered files, and leaves their scenes out."""
    found = sorted((copy.folder / "results").rglob(".digests/*.json"))
    read = {str((path.parents[1] / path.stem).relative_to(copy.folder)): json.loads(path.read_text()) for path in found}
    return {path: one for path, one in read.items() if "/vanilla/" not in path and one["rule"] != "gap_report"}


def script(rule: str) -> Path:
    return REPOSITORY / f"workflow_scripts/{rule}.py"


def readers(copy: WorkflowCopy) -> dict[str, list[str]]:
    """By file that the scene's rules read of results or dataset: the rules that read it."""
    found: dict[str, set[str]] = {}
    known = records(copy)
    for record in known.values():
        rule = record["rule"]
        for path in record["read"]:
            members = known[path]["members"] if path in known else {}
            for name in (path, *(str(Path(path).parent / member) for member in members)):
                found.setdefault(name, set()).add(rule)
        match = READS_DATASET.search(script(rule).read_text())
        for kind in re.findall(r'"(\w+)"', match[1]) if match else ():
            for path in known["results/0001/scene.json"]["dataset"][kind]:
                found.setdefault(path, set()).add(rule)
    return {path: sorted(rules) for path, rules in sorted(found.items()) if "v1.0-mini" not in path}


def refusal(copy: WorkflowCopy, rule: str, log: Path) -> str | None:
    """What the script of a rule logs when it refuses altered inputs; None where it accepts them.

    It gets no settings: a script that accepts its inputs fails soon after.
    """
    read = next(r["read"] for r in records(copy).values() if r["rule"] == rule and r["read"])
    name = {"scene": "scene", "scene_refined": "scene", "parser": "parser"}
    inputs = NamedFiles(list(read), [name.get(Path(path).stem, Path(path).stem) for path in read])
    wildcards = SimpleNamespace(scene="0001", method="street")
    stage = SimpleNamespace(
        input=inputs, output=[], wildcards=wildcards, log=[str(log)], threads=1, rule=rule, params=None, resources=None
    )
    with pytest.raises(SystemExit):
        runpy.run_path(str(script(rule)), {"snakemake": stage})
    line = log.read_text().splitlines()[-1]
    return line if re.search("not what the rule wrote|changed since the rule", line) else None


def is_result(path: str) -> bool:
    """Whether a rule wrote it: the dataset's files are named through a link in the results."""
    return path.startswith("results") and "/.data/" not in path


def test_each_of_100_flipped_bits_is_refused_with_file_and_rule(finished, tmp_path, monkeypatch):
    """Bits at fixed random places of intermediates, masks, images and sweeps, each read by one of its rules."""
    monkeypatch.chdir(finished.folder)
    random, places = np.random.default_rng(0), readers(finished)
    kinds = {Path(path).name if is_result(path) else Path(path).suffix for path in places}
    whole = {"scene.json", "own_car.json", "masks.json", "seed.ply", "parser.npz", "checkpoint.npz", "train.json"}
    assert whole <= kinds
    assert {".jpg", ".bin"} <= kinds and any("masks/regions" in path for path in places)
    names, silent = list(places), []
    always = [name for name in names if is_result(name) and "/masks/" not in name]
    for number in range(max(FLIPS, len(always) + OF_MEMBERS)):
        path = Path(always[number] if number < len(always) else str(random.choice(names)))
        rule = str(random.choice(places[str(path)]))
        whole = path.read_bytes()
        content = bytearray(whole)
        content[random.integers(len(content))] ^= 1 << int(random.integers(8))
        path.write_bytes(content)
        message = refusal(finished, rule, tmp_path / "it.log")
        path.write_bytes(whole)
        if str(path) not in (message or "") or not re.search(r"rerun: the rule '\w+' re(builds|ads) it", message):
            silent.append((str(path), rule, message))
    assert not silent


def test_unaltered_files_are_accepted(finished, tmp_path, monkeypatch):
    monkeypatch.chdir(finished.folder)
    for rule in {rule for rules in readers(finished).values() for rule in rules}:
        assert refusal(finished, rule, tmp_path / "it.log") is None


def test_the_report_leaves_a_scene_with_altered_metrics_out(finished, tmp_path):
    from drivesplat.report.gaps import gap_report
    from drivesplat.settings.report import ReportJob

    copy = finished.again(tmp_path / "copy")
    metrics = copy.folder / "results/0001/metrics.json"
    metrics.write_text(re.sub(r'("psnr": \d)', r"\g<1>1", metrics.read_text(), count=1))
    report = gap_report([str(metrics)], ReportJob(expected={"0001": {}}, reference=None, random_seed=0), tmp_path)
    assert [(one["scene"], str(metrics) in one["why"]) for one in report["left_out"]] == [("0001", True)]


DELETE = re.compile(r"(results/\S+): .*; delete (\S+) and rerun: the rule '(\w+)' rebuilds it")


@pytest.mark.parametrize(
    ("path", "rule", "lost", "target"),
    [
        pytest.param(
            "results/0001/masks/regions/CAM_FRONT/*.png",
            "masks",
            True,
            "results/0001/street/checkpoint.npz",
            marks=pytest.mark.slow,
        ),
        pytest.param("results/0001/seed.ply", "lidar_seed", False, "results/0001/parser.npz", marks=pytest.mark.slow),
    ],
)
def test_following_the_advice_rebuilds_the_file(finished, tmp_path, path, rule, lost, target):
    """Members that Snakemake does not know, lost and altered, and a declared output."""
    copy = finished.again(tmp_path / "copy")
    (copy.folder / "results/0001/parser.npz").unlink()
    (copy.folder / "results/0001/street/checkpoint.npz").unlink()
    damaged = sorted(copy.folder.glob(path))[-1]
    whole = damaged.read_bytes()
    if lost:
        damaged.unlink()
    else:
        damaged.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    refused = copy.run(target)
    name, delete, named = DELETE.search(refused.stdout).groups()
    assert refused.returncode and named == rule and (copy.folder / name) == damaged
    (copy.folder / (name if delete == "it" else delete)).unlink()
    done = copy.run(target)
    assert done.returncode == 0, done.stdout
    assert damaged.read_bytes() == whole
