"""Ten synthetic drives as a batch, one of them with a broken image (`make test-batch`; a quarter of an hour on
two cores)."""

import os

import pytest
import yaml
from helpers.workflow_copy import REPOSITORY, WorkflowCopy

pytestmark = [
    pytest.mark.batch,
    pytest.mark.skipif("DRIVESPLAT_BATCH" not in os.environ, reason="a quarter of an hour: make test-batch"),
]

BROKEN = "third_street"
DONE = (
    "drives", "other_street", "stands", "night", "nothing_moves", "noisy_poses", "traffic", "empty_street",
    "stands_at_night",
)  # fmt: skip
METHODS = ("vanilla", "street")


@pytest.fixture(scope="module")
def batch(tmp_path_factory) -> WorkflowCopy:
    """The ten worlds planned and, but for one, run; the other ends at an image that is cut off."""
    copy = WorkflowCopy.make(tmp_path_factory.mktemp("batch") / "workflow")
    preset = yaml.safe_load((REPOSITORY / "presets/demo_batch.yaml").read_text())
    copy.config = {**preset, "lpips": {"enabled": False}, "device": "cpu"}
    copy.write_config()
    assert copy.run(f"resources/demo_batch/{BROKEN}/truth/truth.json").returncode == 0
    image = sorted((copy.folder / f"resources/demo_batch/{BROKEN}/samples/CAM_FRONT").iterdir())[4]
    image.write_bytes(image.read_bytes()[:300])
    done = copy.run("all", flags=("--keep-going",), timeout=7200)
    assert done.returncode != 0 and f"{BROKEN}: extract: " in done.stdout, done.stdout[-3000:]
    return copy


def test_nine_finish_and_the_tenth_is_named_in_a_partial_report(batch):
    report = batch.read("results/demo_batch/gap_report.json")
    assert report["partial"] is True
    assert {(row["scene"], row["method"]) for row in report["rows"]} == {(s, m) for s in DONE for m in METHODS}
    (missing,) = report["missing"]
    assert missing["scene"] == BROKEN and missing["why"].startswith("extract: ") and "CAM_FRONT" in missing["why"]
    for scene in DONE:
        for method in METHODS:
            assert (batch.folder / f"results/demo_batch/{scene}/{method}/original.mp4").stat().st_size > 10_000


def test_a_second_call_plans_the_broken_drive_and_nothing_else(batch):
    planned = batch.planned("all")
    assert planned["extract"] == planned["gap_report"] == 1 and planned["train"] == len(METHODS)
    assert not any(name.startswith("demo_world") for name in planned)
    done = batch.run(*(f"results/demo_batch/{scene}/metrics.json" for scene in DONE), flags=("-n",))
    assert "Nothing to be done" in done.stdout
