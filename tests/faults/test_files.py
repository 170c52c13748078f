"""Files that are truncated, foreign or malicious, by every reader of the workflow; files that can only be whole."""

import ast
import pickle
import re
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import REPOSITORY
from helpers.syntax_trees import source_of, tree_of

from drivesplat.editing.assets.library import read_asset_index
from drivesplat.errors import ResultError
from drivesplat.evaluation.backbone import read_backbone
from drivesplat.evaluation.lpips_map import load_alexnet
from drivesplat.evaluation.scene_metrics import read_baselines, read_evaluations
from drivesplat.export.far_gaussians import read_far
from drivesplat.io.point_cloud import read_ply
from drivesplat.io.storage import read_json, read_record
from drivesplat.lidar.depth_record import read_lidar_depth
from drivesplat.lidar.objects.record import read_discovered
from drivesplat.model.checkpoint import read_checkpoint
from drivesplat.model.splat_ply import read_splat_ply
from drivesplat.preprocess.poses.triangulated import read_triangulated
from drivesplat.provenance.file_digests import checked_digest, record_output
from drivesplat.readers.truth import read_truth
from drivesplat.scene.blocks import read_blocks
from drivesplat.scene.ego_mask import read_ego_mask
from drivesplat.scene.light import read_light
from drivesplat.scene.masks import read_masks_record
from drivesplat.scene.scan_record import read_scans
from drivesplat.scene.scene import read_scene
from drivesplat.scene.training_record import read_training_record
from drivesplat.training.resume_state import resumable
from drivesplat.training.stage import read_summary
from drivesplat.trajectories.actor_record import read_actors

SOURCES = [
    path for folder in ("drivesplat", "workflow_scripts", "benchmarks") for path in (REPOSITORY / folder).rglob("*.py")
]


def alexnet(path: Path) -> None:
    load_alexnet(torch.nn.Linear(1, 1), path)


READERS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "scene.json": (read_scene, "extract"),
    "scene_refined.json": (read_scene, "refine_poses"),
    "own_car.json": (read_ego_mask, "own_car"),
    "blocks.json": (read_blocks, "blocks"),
    "masks.json": (lambda path: read_masks_record(path.parent), "masks"),
    "discovered.json": (read_discovered, "discover"),
    "discovered/scene.json": (read_scene, "relabel"),
    "unlabelled/masks/masks.json": (lambda path: read_masks_record(path.parent), "regions"),
    "seed.ply": (lambda path: read_ply(path, "lidar_seed"), "lidar_seed"),
    "parser.npz": (read_training_record, "parser"),
    "actors.npz": (read_actors, "actors"),
    "lidar_depth.npz": (read_lidar_depth, "lidar_depth"),
    "scans.npz": (read_scans, "scans"),
    "triangulated.npz": (read_triangulated, "refine_poses"),
    "checkpoint.npz": (read_checkpoint, "train"),
    "train.json": (read_summary, "train"),
    "eval.json": (lambda path: read_evaluations([str(path)]), "evaluate"),
    "scan_baselines.json": (lambda path: read_baselines(str(path)), "scan_baselines"),
    "truth.json": (read_truth, "demo_world"),
    "backbone.json": (read_backbone, "lpips_backbone"),
    "alexnet.pth": (alexnet, "lpips_backbone"),
    "far.npz": (read_far, "far_gaussians"),
    "light.json": (read_light, "light"),
    "assets.json": (read_asset_index, "actor_assets"),
    "metrics.json": (lambda path: read_json(path, rule="scene_metrics"), "scene_metrics"),
    "brakes.json": (lambda path: read_record(path, "run", "episodes"), "run"),
    "splat.ply": (partial(read_splat_ply, rule="export"), "export"),
}
"""By the name of a file, who reads it, and the rule that makes it."""


class Malicious:
    """A pickle of it makes a file when it is loaded."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


def write(path: Path, kind: str) -> None:
    """Puts a file at `path` that no rule wrote there whole."""
    attack = {"provenance": {}, "regions": {}, "extra": Malicious(path.parent / "executed")}
    content = {
        "empty": b"",
        "truncated": b'{"schema": 1, "frames": [{"camera": "CAM_FR',
        "a web page": b"<html>404</html>",
        "a malicious pickle": pickle.dumps(attack, protocol=2),
        "a pickle of another record": pickle.dumps({"note": "of someone else"}),
        "a list": b"[1, 2, 3]",
        "another record": b'{"note": "of someone else"}',
        "bytes": bytes(range(256)),
    }
    if kind == "a malicious checkpoint":
        torch.save(attack, path)
    elif kind == "a folder":
        path.mkdir()
    elif kind == "a link loop":
        path.symlink_to(path.name)
    else:
        path.write_bytes(content[kind])


BROKEN = [
    "empty", "truncated", "a web page", "bytes", "a malicious pickle", "a malicious checkpoint", "a folder",
    "a link loop",
]  # fmt: skip
FOREIGN = ["a pickle of another record", "a list", "another record"]
LEFT_OUT = ("metrics.json", True)
"""The report leaves a foreign one out and names it: tests/report/test_report.py."""


CASES = [(name, kind) for name in READERS for kind in (*BROKEN, *FOREIGN) if (name, kind in FOREIGN) != LEFT_OUT]


@pytest.mark.parametrize(("name", "kind"), CASES)
def test_every_reader_stops_names_file_and_rule_and_executes_nothing(tmp_path, name, kind):
    (read, rule), path = READERS[name], tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path, kind)
    with pytest.raises(ResultError) as error:
        read(path)
    message = str(error.value)
    assert message.startswith(f"{path}: ") and f"delete it and rerun: the rule '{rule}' rebuilds it" in message
    assert "\n" not in message
    assert not (path.parent / "executed").exists()


@pytest.mark.parametrize("kind", ["a folder", "a link loop"])
@pytest.mark.parametrize("recorded", [True, False])
def test_an_input_that_is_no_file_is_refused_before_a_job_begins(tmp_path, kind, recorded):
    path = tmp_path / "checkpoint.npz"
    path.write_bytes(b"sound")
    if recorded:
        record_output(path, "train", {}, {})
    path.unlink()
    write(path, kind)
    advice = "the rule 'train' rebuilds it" if recorded else "its rule rebuilds it"
    with pytest.raises(ResultError, match=rf"checkpoint\.npz: cannot be read \(.*delete it and rerun: {advice}"):
        checked_digest(path)


@pytest.mark.parametrize("kind", BROKEN)
def test_a_resume_state_of_any_kind_executes_nothing(tmp_path, kind):
    write(tmp_path / "state.npz", kind)
    assert resumable(tmp_path / "state.npz", "a training") is None
    assert not (tmp_path / "executed").exists()


def test_no_script_reads_results_but_by_a_reader_that_is_tested():
    """The first four, and the inserts, are made of others. tests/readers has damaged drive folders."""
    names = "evaluation_data inputs evaluation_inputs scan_evaluation_inputs json scene ego_mask masks_record ply "
    names += (
        "truth training_record actors lidar_depth scans triangulated summary checkpoint evaluations baselines blocks "
    )
    tested = {f"read_{name}" for name in (names + "backbone far discovered inserts record drive").split()}
    used = {
        name.name
        for path in (REPOSITORY / "workflow_scripts").glob("*.py")
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.ImportFrom)
        for name in node.names
        if name.name.startswith(("read_", "load_"))
    }
    assert used <= tested


def dotted(node: ast.expr) -> str:
    """The name of what is called, 'torch.load', where '()' stands for any other expression."""
    if isinstance(node, ast.Attribute):
        return f"{dotted(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else "()"


@cache
def calls(path: Path) -> list[tuple[str, ast.Call]]:
    """The calls in a module, by what is called: 'torch.load', 'open'."""
    return [(dotted(node.func), node) for node in ast.walk(tree_of(path)) if isinstance(node, ast.Call)]


EXECUTES = {
    "eval", "exec", "pickle.load", "pickle.loads", "np.load", "numpy.load", "yaml.unsafe_load", "yaml.full_load",
    "marshal.load", "marshal.loads", "joblib.load", "shelve.open", "torch.jit.load", "torch.package.PackageImporter",
}  # fmt: skip
"""What would run what a file tells it to, or would where it is called with other arguments."""
LOADERS = {*EXECUTES, "torch.load", "yaml.load"}
LOADS = re.compile(r"\b(eval|exec|open|PackageImporter|\w*load\w*)\(|pickle\.Unpickler\(")
"""In the text of every module that calls one of them."""


def test_nothing_loads_a_file_in_a_way_that_could_execute_it():
    """torch's loader takes tensors alone, YAML's is a safe one, and no pickle is executed."""
    found = set()
    for path in (path for path in SOURCES if LOADS.search(source_of(path))):
        for name, call in calls(path):
            if name not in LOADERS:
                continue
            arguments = {keyword.arg: ast.unparse(keyword.value) for keyword in call.keywords}
            safe = name == "np.load" and arguments.get("allow_pickle") == "False"
            unsafe = name == "torch.load" and arguments.get("weights_only") != "True"
            if (name in EXECUTES and not safe) or unsafe:
                found.add((path.name, name))
            if name == "yaml.load" and arguments.get("Loader") != "_EveryKeyOnce":
                found.add((path.name, name))
        if "pickle.Unpickler(" in source_of(path):
            found.add((path.name, "pickle.Unpickler"))
    assert not found


WRITES = ("write_text", "write_bytes", "tofile", "np.save", "np.savez", "np.savetxt", "imwrite", "to_csv", "json.dump")
WRITERS = re.compile(r"\bopen\(|" + "|".join(map(re.escape, WRITES)))
"""In the text of every module that writes."""
NO_RESULTS = {
    "config_document.py": "config.yaml, by hand",
    "tried.py": "docs/tried.md, by hand",
    "mutants.py": "code with a fault, in a temporary folder",
    "aligned_zip.py": "an archive aside, and members in a folder that gets its name when it is complete",
    "recordings.py": "files of a drive folder, whose drive.json is written last",
    "features.py": "pairs of images in a temporary folder",
    "compile.py": "gsplat's build, with its own log",
    "starts.py": "a script to time, in a temporary folder",
    "runs.py": "what Snakemake says, as it says it",
    "nuscenes_mini.py": "a lock",
    "file_lock.py": "a lock",
    "code_digest.py": "a cache; a truncated entry is computed again",
    "fetch.py": "a download, which is checked before it counts",
    "reader.py": "tables of one scene in a temporary folder",
    "scene_tables.py": "files in the making in a temporary folder, which go that way when whole",
    "storage.py": "the way all others go",
    "sweep_file.py": "into a file of storage",
    "array_file.py": "members of an archive, which goes that way",
}
"""The modules that open files for writing by themselves, and what."""


NO_FILES = ("Image.open", "tab.open", "drivesplat.open")
"""Calls that open no file for writing: an image for reading, a page in a browser, a trained drive."""


def test_results_are_written_whole_or_not_at_all():
    """Every file that is written goes through `drivesplat.io.storage`, beside its place and into it once it is on
    disk."""
    found = set()
    for path in (path for path in SOURCES if path.name not in NO_RESULTS and WRITERS.search(source_of(path))):
        for name, call in calls(path):
            place = {"open": 1}.get(name, 0 if name.endswith(".open") and name not in NO_FILES else None)
            named = [keyword.value for keyword in call.keywords if keyword.arg == "mode"]
            modes = [] if place is None else [*call.args[place : place + 1], *named]
            writes = name.endswith(WRITES) and not (name.endswith("to_csv") and not call.args)  # without a path: text
            if any(set(ast.unparse(mode)) & set("wax+") for mode in modes) or writes:
                found.add((path.name, name))
    assert not found
