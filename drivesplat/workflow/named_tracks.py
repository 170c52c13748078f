"""The tracks that settings name, and their check before a run deletes results that it would remake."""

from collections.abc import Callable, Iterable
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.settings.config import Config
from drivesplat.settings.edit import Edit
from drivesplat.settings.track_references import EditReference, TrackReferences
from drivesplat.workflow.stages import scene_edits

RULES_OF_SUBJECT = ("ghost_panel", "remove_actor")
"""Rules that show the vehicle that `subjects` names."""


def track_references(config: Config, scene: str) -> TrackReferences:
    """The tracks that the settings of a scene name; those of edits where a method can be edited. Raises ConfigError
    where the edits file is invalid."""
    subject, editable = config.subjects.get(scene), any(method.moving_parts for method in config.methods.values())
    edits = scene_edits(config, scene) if editable else {}
    named = [reference for name, edit in edits.items() for reference in _of_edit(name, edit)]
    return TrackReferences(scene=scene, subject=subject.track if subject else None, edits=tuple(named))


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
        if scene in extracted or rule not in (*RULES_OF_SUBJECT, "edit"):
            continue
        references = track_references(config, scene)
        subject = references.subject if rule in RULES_OF_SUBJECT else None
        edits = tuple(one for one in references.edits if rule == "edit" and one.edit == job.wildcards.edit)
        _refuse(TrackReferences(scene=scene, subject=subject, edits=edits), scene_file(job.wildcards))


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
