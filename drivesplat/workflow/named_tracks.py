"""The tracks that settings name, and their check before a run deletes results that it would remake."""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.settings.config import Config
from drivesplat.settings.edit import Edit
from drivesplat.settings.track_references import EditReference, TrackReferences
from drivesplat.workflow.film_names import EDITS, scene_edits

RULES_OF_EDITS = ("edit", "quad", "drive_folder", "scan_folder")
"""Rules that render an edit; the last two also render trajectories, which name no tracks."""
RULES_OF_SUBJECT = ("ghost_panel", "remove_actor")
"""Rules that show the vehicle that `subjects` names."""
FILES_OF_SUBJECT = ("ghost_panel", "removal", "with_car", "without_car")
"""Their files, without suffix."""
TARGETS = "DRIVESPLAT_TARGETS"
"""The environment variable with the targets of a run as JSON, for the processes of its jobs."""


def run_targets(targets: Sequence[str], is_main: bool) -> list[str] | None:
    """The targets of the run that this process belongs to: its own in the main process, which hands them to those of
    jobs. None where they are not known."""
    if is_main:
        os.environ[TARGETS] = json.dumps(list(targets))
    handed = os.environ.get(TARGETS)
    return None if handed is None else json.loads(handed)


def track_references(config: Config, scene: str, targets: Sequence[str] | None = ()) -> TrackReferences:
    """The tracks that the settings of a scene name and that a run for `targets` (none: everything) uses. Without known
    targets (None) there are none. Raises ConfigError where the edits file is invalid."""
    subject, editable = config.subjects.get(scene), any(method.object_parts for method in config.methods.values())
    used = _Used(scene, targets)
    edits = scene_edits(config, scene) if editable else {}
    named = [reference for name, edit in edits.items() if used.edit(name) for reference in _of_edit(name, edit)]
    return TrackReferences(scene=scene, subject=subject.track if subject and used.subject else None, edits=tuple(named))


class _Used:
    """What a run for some targets uses of a scene's named tracks."""

    def __init__(self, scene: str, targets: Sequence[str] | None):
        self._everything = targets is not None and (not targets or "all" in targets)
        self._targets = set(targets or ())
        self._files = [path for path in map(PurePosixPath, targets or ()) if scene in path.parts]

    def edit(self, name: str) -> bool:
        parts = [path.with_suffix("").parts for path in self._files]
        folders = (pair for names in parts for pair in pairwise(names))
        of_edits = any(folder in ("edits", "quad") and edit == name for folder, edit in folders)
        return self._everything or bool({"edits", "drives"} & self._targets) or of_edits

    @property
    def subject(self) -> bool:
        shown = any(path.stem in FILES_OF_SUBJECT for path in self._files)
        return self._everything or "looks" in self._targets or shown


def _of_edit(name: str, edit: Edit) -> Iterable[EditReference]:
    """The tracks that the steps of an edit name, without its own copies."""
    copies: list[str] = []
    for number, step in enumerate(edit.steps, start=1):
        change: Any = step.change
        for track in (getattr(change, "track", None), getattr(change, "other", None)):
            if track is not None and not any(copy.startswith(track) for copy in copies):
                yield EditReference(edit=name, step=f"step {number} ({step.kind})", track=track)
        copies += [change.name] if hasattr(change, "name") else []


def refuse_wrong_tracks(config: Config, jobs: Iterable[Any], scene_file: Callable[[Any], str]) -> None:
    """Raises ConfigError where one of Snakemake's planned `jobs` would fail on a track that the settings name. Scenes
    whose tracks this run extracts are left to the stages `extract` and `actors`, which make the same check.

    `scene_file` gives the path of a scene's record by the wildcards of a job.
    """
    planned = list(jobs)
    extracted = {job.wildcards.scene for job in planned if job.rule.name == "extract"}
    for job in planned:
        rule, scene = job.rule.name, getattr(job.wildcards, "scene", None)
        if scene in extracted or rule not in (*RULES_OF_SUBJECT, *RULES_OF_EDITS):
            continue
        references = track_references(config, scene)
        subject = references.subject if rule in RULES_OF_SUBJECT else None
        edit = _edit_of(job.wildcards) if rule in RULES_OF_EDITS else None
        edits = tuple(one for one in references.edits if one.edit == edit)
        _refuse(TrackReferences(scene=scene, subject=subject, edits=edits), scene_file(job.wildcards))


def _edit_of(wildcards: Any) -> str | None:
    """The edit that a job renders; None for the folder of a trajectory."""
    if getattr(wildcards, "kind", EDITS) != EDITS:
        return None
    return wildcards.drive if hasattr(wildcards, "drive") else wildcards.edit


def _refuse(references: TrackReferences, scene_file: str) -> None:
    if references.subject is None and not references.edits:
        return
    from drivesplat.scene.scene import read_scene
    from drivesplat.scene.track_references import refuse_unknown_tracks  # numpy; most runs name no tracks

    try:
        scene = read_scene(scene_file)
    except ResultError:
        return  # the job that reads this file reports it
    refuse_unknown_tracks(references, scene)
