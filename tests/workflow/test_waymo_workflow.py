"""Waymo segments through the rules before training; tests/readers/test_five_formats.py compares them with tables."""

import pytest
from helpers.shared_runs import VANILLA
from helpers.waymo_drive import NAME, tiny_drive
from helpers.waymo_files import write_v1, write_v2
from helpers.workflow_copy import WorkflowCopy

from drivesplat.scene.scene import read_scene

pytestmark = [pytest.mark.workflow, pytest.mark.slow, pytest.mark.xdist_group("waymo_workflow")]
BEGINNING = NAME[:19]
"""Names the segment of v1, so that both are scenes of their own."""
MADE = [f"results/{scene}/{name}" for scene in (NAME, BEGINNING) for name in ("seed.ply", "masks/masks.json")]


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> WorkflowCopy:
    front = {"cameras": ["FRONT"], "eval_camera": "FRONT"}
    datasets = {
        "v2": {"reader": "waymo", "dataroot": "waymo/v2", "scenes": [NAME], "overrides": front},
        "v1": {"reader": "waymo", "dataroot": "waymo/v1", "scenes": [BEGINNING], "overrides": front},
    }
    folder = tmp_path_factory.mktemp("waymo") / "workflow"
    made = WorkflowCopy.make(folder, datasets=datasets, methods=VANILLA, sweeps=False)
    drive, _ = tiny_drive(made.folder / "data")
    write_v2(made.folder / "waymo/v2", drive)
    write_v1(made.folder / "waymo/v1", drive)
    done = made.run(*MADE)
    assert done.returncode == 0, done.stdout
    return made


def test_both_versions_give_the_same_seed_and_masks(copy):
    for name in ("seed.ply", *(f"masks/{kind}/FRONT" for kind in ("sky", "regions"))):
        one, other = (copy.folder / "results" / scene / name for scene in (NAME, BEGINNING))
        files = [(one, other)] if one.is_file() else zip(sorted(one.iterdir()), sorted(other.iterdir()), strict=True)
        contents = [(a.read_bytes(), b.read_bytes()) for a, b in files]
        if name == "seed.ply":  # its header holds the provenance
            contents = [tuple(content.split(b"end_header", 1)[1] for content in pair) for pair in contents]
        assert all(a == b for a, b in contents) and contents


def test_results_are_exact_and_an_altered_recording_is_refused(copy):
    assert copy.planned(*MADE) == {}
    scene = read_scene(copy.folder / f"results/{NAME}/scene.json")
    image = copy.folder / scene.frames[0].image_path
    assert image.relative_to(copy.folder / f"results/{NAME}/images/FRONT").suffix == ".jpg"
    whole = image.read_bytes()
    image.write_bytes(whole + b"more")
    (copy.folder / f"results/{NAME}/seed.ply").unlink()
    done = copy.run(f"results/{NAME}/seed.ply")
    assert done.returncode != 0 and "changed since the rule 'extract' read it" in done.stdout, done.stdout
    image.write_bytes(whole)
    done = copy.run(f"results/{NAME}/seed.ply")
    assert done.returncode == 0, done.stdout
