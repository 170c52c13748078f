"""Maps by a network in the workflow: what they replace, what reruns, and what is refused before any job."""

import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.tiny_networks import save_onnx
from PIL import Image

from drivesplat.errors import ConfigError
from drivesplat.preprocess.segmentation.label_sets import CLASSES, SKY
from drivesplat.scene.masks import UNLABELLED
from drivesplat.settings.segment import DEFAULT_MODEL
from drivesplat.workflow.plan import Plan
from drivesplat.workflow.stages import stage_settings

ROAD = CLASSES.index("road")
WEIGHTS = np.zeros((19, 3))
WEIGHTS[SKY], WEIGHTS[ROAD] = (-1.0, 0.0, 1.0), (1.0, 0.0, -1.0)
"""Of a network that calls what is more blue than red the sky, and all else a road."""
AT = SimpleNamespace(scene="a1")


def plan(**values: Any) -> Plan:
    datasets = {"a": {"scenes": ["a1"]}, "b": {"scenes": ["b1"]}}
    given = {"datasets": datasets, "results_dir": "r", "refine_poses": {"enabled": False}}
    return Plan({**given, **values}, str(REPOSITORY))


def masks_of(made: Plan, scene: str = "a1") -> dict[str, Any]:
    return json.loads(stage_settings(made.config, "masks", scene))["masks"]


def test_maps_replace_masks_that_have_no_folder_of_the_users():
    default = plan()
    assert default.segmented(AT) == [] and masks_of(default)["sky_folder"] is None
    made = plan(segment={"model": "default", "use": ["sky", "semantic"]}, masks={"semantic_folder": "mine"})
    assert made.segmented(AT) == ["r/a1/segmented/masks.json"] and made.network_files(AT) == []
    job = json.loads(stage_settings(made.config, "segment", "a1"))
    assert job == {"model": DEFAULT_MODEL, "labels": None, "height": 512, "images": {"width": None}}
    found = masks_of(made)
    folder = found["sky_folder"].split("/")
    assert folder[:3] == ["r", "a1", "segmented"] and folder[4] == "sky" and len(folder[3]) == 8
    assert found["semantic_folder"] == "mine" and found["regions_folder"] is None
    assert masks_of(made, "b1")["sky_folder"] == found["sky_folder"].replace("a1", "b1")
    alone = masks_of(plan(segment={"model": "a/b"}))
    assert alone["sky_folder"] != found["sky_folder"] and alone["semantic_folder"] is None
    of_regions = masks_of(plan(segment={"model": "default", "use": ["regions"]}))
    assert of_regions["sky_folder"] is None and of_regions["regions_folder"].endswith(f"{folder[3]}/regions")
    unused = plan(segment={"model": "default", "use": ["sky"]}, masks={"sky_folder": "mine"})
    assert unused.segmented(AT) == [] and masks_of(unused)["sky_folder"] == "mine"


def test_without_a_network_nothing_depends_on_other_settings_of_maps():
    default, others = plan(), plan(segment={"height": 64, "use": ["regions"], "labels": "ade20k"})
    for stage in ("masks", "own_car", "train", "evaluate"):
        method = "street" if stage in ("train", "evaluate") else None
        assert stage_settings(default.config, stage, "a1", method) == stage_settings(others.config, stage, "a1", method)


def test_files_of_a_network_of_ones_own_are_inputs(tmp_path):
    path = save_onnx(tmp_path / "net.onnx", WEIGHTS)
    assert plan(segment={"model": str(path)}).network_files(AT) == [str(path)]
    with pytest.raises(ConfigError, match=r"segment.model: there is no .*absent.onnx; name a folder with config.json"):
        plan(segment={"model": str(tmp_path / "absent.onnx")}).network_files(AT)
    with pytest.raises(ConfigError, match=r"scene a1 has no maps by a network: segment.model is null"):
        plan().network_files(AT)


@pytest.mark.workflow
def test_a_network_makes_the_masks_of_a_finished_scene_again(finished_run, tmp_path):
    """Once; the same network again reruns nothing, and changed weights rerun it."""
    copy = finished_run.again(tmp_path / "workflow")
    path = save_onnx(tmp_path / "net.onnx", WEIGHTS)
    with copy.set_to(segment={"model": str(path), "height": 64, "use": ["sky", "semantic"]}):
        done = copy.run("results/0001/masks/masks.json")
        assert done.returncode == 0, done.stdout
        made, masks = (copy.read(f"results/0001/{folder}/masks.json") for folder in ("segmented", "masks"))
        assert masks["sky"] == "masks" and masks["regions"] == "boxes" and masks["semantic_classes"] == ROAD + 1
        assert made["labels"] == "cityscapes" and made["images"] == masks["images"] == 10 and made["reused"] == 0
        assert masks["sky_share"] == pytest.approx(made["sky_share"]) and 0.1 < made["sky_share"] < 0.9
        assert masks["provenance"]["stages"]["masks"]["settings"]["masks"]["sky_folder"] == (
            f"results/0001/segmented/{made['folder']}/sky"
        )
        for sky in sorted((copy.folder / "results/0001/masks/sky/CAM_FRONT").glob("*.png"))[:2]:
            classes = np.asarray(Image.open(sky.parents[2] / f"semantic/CAM_FRONT/{sky.name}"))
            np.testing.assert_array_equal(np.asarray(Image.open(sky)) > 0, classes == UNLABELLED)
        assert copy.planned("results/0001/masks/masks.json") == {}
        save_onnx(path, 2.0 * WEIGHTS)
        planned = copy.planned("metrics")
        assert (planned["segment"], planned["masks"], planned["train"]) == (1, 1, 2) and "extract" not in planned
