"""Damaged records of Snakemake: removed and named, and the run goes on."""

import base64

import pytest
from helpers.shared_runs import VANILLA
from helpers.workflow_copy import WorkflowCopy

from drivesplat.workflow.snakemake_log import drop_foreign_records

FOREIGN = {"binary": bytes(range(256)), "a list": b"[1, 2]", "a number": b"7"}


@pytest.mark.slow
@pytest.mark.workflow
def test_a_run_with_damaged_records_names_them_and_goes_on(tmp_path):
    copy = WorkflowCopy.make(tmp_path / "workflow", methods=VANILLA)
    assert copy.run("results/0001/own_car.json").returncode == 0
    records = list((copy.folder / ".snakemake/metadata").glob("*"))
    for file, content in zip(records, FOREIGN.values(), strict=False):
        file.write_bytes(content)
    done = copy.run("results/0001/own_car.json")
    assert done.returncode == 0 and "Traceback" not in done.stdout, done.stdout
    (line,) = (line for line in done.stdout.splitlines() if line.startswith("drivesplat: .snakemake/metadata"))
    assert "results/0001/own_car.json" in line and "results/0001/scene.json" in line
    assert "were damaged" not in copy.run("results/0001/own_car.json").stdout


@pytest.mark.parametrize("content", FOREIGN.values(), ids=FOREIGN)
def test_only_records_that_snakemake_fails_on_are_removed(tmp_path, content):
    sound, written, long = tmp_path / "c291bmQ=", tmp_path / "d3JpdHRlbg==", "results/" + 40 * "long"
    sound.write_text('{"rule": "masks"}')
    written.write_text('{"rule": "mas')
    name = base64.b64encode(long.encode()).decode()
    split = tmp_path / f"@{name[:200]}" / name[200:]
    split.parent.mkdir()
    split.write_bytes(content)
    sentence = drop_foreign_records(tmp_path)
    assert sentence is not None and f"records of {long} were damaged" in sentence
    assert sound.exists() and written.exists() and not split.exists()
    assert drop_foreign_records(tmp_path) is None and drop_foreign_records(tmp_path / "absent") is None
    for i in range(5):
        (tmp_path / base64.b64encode(f"results/{i}".encode()).decode()).write_bytes(content)
    sentence = drop_foreign_records(tmp_path)
    assert sentence is not None and "results/0, results/1, results/2 and 2 more" in sentence
