"""Several scenes: one that fails, one more, one less, and results that no record of Snakemake's goes with."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import pytest
from helpers.drives import World
from helpers.workflow_copy import TINY_TRAINING, WorkflowCopy

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("scenes")]

FIGURES = ("metrics", "report")
NEW_SCENE = {
    "extract": 1, "own_car": 1, "lidar_seed": 1, "parser": 1, "masks": 1, "train": 1, "evaluate": 1, "scene_metrics": 1,
    "metrics": 1, "gap_report": 1, "report": 1,
}  # fmt: skip


@dataclass
class Batch:
    """A workflow of the scenes 0001 and 0002, of which the second had a broken image at first; what its run `said`."""

    copy: WorkflowCopy
    image: Path
    whole: bytes
    output: str = ""

    def scenes(self, *names: str) -> None:
        self.copy.config["datasets"]["nuscenes"]["scenes"] = list(names)
        self.copy.write_config()


@pytest.fixture(scope="module")
def batch(tmp_path_factory) -> Batch:
    world = World(scenes=("0001", "0002", "0003"))
    training = TINY_TRAINING | {"iterations": 20}
    folder = tmp_path_factory.mktemp("batch") / "workflow"
    copy = WorkflowCopy.make(folder, world, methods={"vanilla": {}}, train=training)
    image = folder / "data/samples/CAM_FRONT/0002__0004.jpg"
    made = Batch(copy, image, image.read_bytes())
    made.scenes("0001", "0002")
    image.write_bytes(made.whole[: len(made.whole) // 3])
    done = copy.run(*FIGURES, flags=("--keep-going",))
    assert done.returncode != 0
    made.output = done.stdout
    return made


@pytest.fixture(scope="module")
def healed(batch) -> Batch:
    """The same once the image is whole and the run was made again. What comes after asks for it by itself: pytest's
    workers take tests from one another, and each makes its own batch."""
    batch.image.write_bytes(batch.whole)
    done = batch.copy.run(*FIGURES)
    assert done.returncode == 0, done.stdout
    return batch


def test_one_scene_that_fails_stops_no_other_and_stands_in_a_partial_report(batch):
    """The rule of the report waits for all scenes, so that the end of the run writes it."""
    report = batch.copy.read("results/gap_report.json")
    assert report["partial"] is True and [row["scene"] for row in report["rows"]] == ["0001"]
    (missing,) = report["missing"]
    assert missing["scene"] == "0002" and missing["why"].startswith("extract: ") and batch.image.name in missing["why"]
    page = (batch.copy.folder / "results/gap_report.html").read_text()
    assert "Partial: 1 of 2 configured scenes" in page and batch.image.name in page and "data:image/jpeg" in page
    assert "0002: extract: " in batch.output and "results/gap_report.html" in batch.output
    costs = (batch.copy.folder / "results/costs.csv").read_text()
    assert "0001,vanilla,train," in costs and "0002," not in costs and "<h2>Costs</h2>" in page


def test_once_nothing_fails_the_report_is_whole_and_a_further_run_does_nothing(healed):
    report = healed.copy.read("results/gap_report.json")
    assert report["partial"] is False and [row["scene"] for row in report["rows"]] == ["0001", "0002"]
    assert healed.copy.planned(*FIGURES) == {}


def test_a_scene_more_runs_its_chain_and_the_report_and_a_scene_less_the_report_alone(healed):
    healed.scenes("0001", "0002", "0003")
    assert healed.copy.planned(*FIGURES) == NEW_SCENE
    healed.scenes("0001")
    assert healed.copy.planned(*FIGURES) == {"gap_report": 1, "report": 1}
    healed.scenes("0001", "0002")


def test_results_without_records_are_recognised_as_stale_by_their_provenance(healed, tmp_path):
    """As on another machine: Snakemake has no record of how these files were made, and takes them for good."""
    copy = healed.copy.again(tmp_path / "workflow")
    shutil.rmtree(copy.folder / ".snakemake")
    copy.config["train"] = TINY_TRAINING | {"iterations": 21}
    copy.write_config()
    (copy.folder / "results/gap_report.json").unlink()
    done = copy.run("report")
    assert done.returncode == 0, done.stdout
    report = copy.read("results/gap_report.json")
    assert report["partial"] is True and report["rows"] == []
    assert {item["scene"] for item in report["left_out"]} == {"0001", "0002"}
    assert all("train.iterations" in item["why"] and "21" in item["why"] for item in report["left_out"])
