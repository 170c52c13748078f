"""The tracks that settings name, and their check before a run deletes results that it would remake."""

import json
import os
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import PurePosixPath
from typing import Any

from drivesplat.errors import ConfigError, ResultError
from drivesplat.settings.asset_references import asset_names, asset_of_results
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.edit import Edit
from drivesplat.settings.track_references import EditReference, TrackReferences
from drivesplat.settings.tracks import FOUND, Tracks
from drivesplat.settings.visuals import SubjectSettings
from drivesplat.settings.world import WorldDonor
from drivesplat.workflow.film_names import EDITS, QUAD, scene_edits
from drivesplat.workflow.without_tracks import methods_of

RULES_OF_EDITS = ("edit", "edit_blocks", "quad", "drive_folder", "scan_folder")
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


def track_references(
    config: Config, scene: str, targets: Sequence[str] | None = (), tracks: Tracks = "annotated"
) -> TrackReferences:
    """Those of the annotated or discovered `tracks` that the settings of a scene name and that a run for `targets`
    (none: everything) uses. Without known targets (None) there are none. Raises ConfigError where the edits file is
    invalid."""
    chosen, everything = set(targets or ()), targets is not None and (not targets or "all" in targets)
    files = [path for path in map(PurePosixPath, chosen) if scene in path.parts]
    pairs = (pair for path in files for pair in pairwise(path.with_suffix("").parts))
    films = {name for folder, name in pairs if folder in (EDITS, QUAD)}
    films |= set(for_scene(config, scene).render.quad if "films" in chosen else ())
    every_edit = everything or bool({"edits", "drives", "mcap"} & chosen)
    pictured = everything or "looks" in chosen or any(path.stem in FILES_OF_SUBJECT for path in files)
    editable = any(method.object_parts and method.tracks == tracks for method in methods_of(config, scene).values())
    edits = fitting_edits(config, scene, tracks) if editable else {}
    used = (_of_edit(name, edit) for name, edit in edits.items() if every_edit or name in films)
    named = [reference for references in used for reference in references]
    subject = config.subjects.get(scene, SubjectSettings())
    shown = pictured and shows_subject(subject, tracks)
    return TrackReferences(scene=scene, subject=subject.track if shown else None, edits=tuple(named))


def fitting_edits(config: Config, scene: str, tracks: Tracks) -> dict[str, Edit]:
    """The edits of a scene that name none but the `tracks` of a method. Raises ConfigError where the edits file is
    invalid."""
    fitting = {}
    for name, edit in scene_edits(config, scene).items():
        found = [reference.track.startswith(FOUND) for reference in _of_edit("", edit)]
        if {"annotated": not any(found), "discovered": all(found), "none": not found}[tracks]:
            fitting[name] = edit
    return fitting


def edits_whole(config: Config, scene: str, method: str) -> bool:
    """Whether a method knows its objects by one id in all of a scene: blocks find other ones each by themselves."""
    return not config.is_cut(scene) or config.all_methods[method].tracks == "annotated"


def shows_subject(subject: SubjectSettings, tracks: Tracks) -> bool:
    """Whether the vehicle that the user selected is one that pictures of a method with these tracks show."""
    return subject.track is None or subject.track.startswith(FOUND) == (tracks == "discovered")


def refuse_other_tracks(config: Config, scene: str, method: str, edit: str) -> None:
    """Raises ConfigError if an edit names tracks that a method does not train with."""
    tracks = config.all_methods[method].tracks
    if edit in fitting_edits(config, scene, tracks):
        return
    able = [
        name
        for name, other in methods_of(config, scene).items()
        if other.object_parts and edit in fitting_edits(config, scene, other.tracks)
    ]
    named = dict.fromkeys(reference.track for reference in _of_edit(edit, scene_edits(config, scene)[edit]))
    raise ConfigError(
        f"scene {scene}, edit {edit!r} names {', '.join(named)}, but method {method!r} has tracks: {tracks} (ids of "
        f"discovered ones begin with {FOUND}); methods with the tracks of this edit: {', '.join(able) or 'none'}"
    )


def edits_left_out(config: Config, scenes: Iterable[str]) -> list[str]:
    """A sentence for each of these scenes with edits that fit the tracks of no method that can be edited."""
    sentences = []
    for scene in sorted(set(scenes)):
        known: set[Tracks] = {method.tracks for method in methods_of(config, scene).values() if method.object_parts}
        if not known:
            continue
        fitting = {name for tracks in known for name in fitting_edits(config, scene, tracks)}
        absent = [name for name in scene_edits(config, scene) if name not in fitting]
        if absent:
            sentences.append(
                f"scene {scene}: no method has the tracks that these edits name, which are left out: "
                f"{', '.join(absent)} (methods.<name>.tracks: {' or '.join(sorted(known))})"
            )
    return sentences


def _of_edit(name: str, edit: Edit) -> Iterable[EditReference]:
    """The tracks that the steps of an edit name, without its own copies."""
    copies: list[str] = []
    for number, step in enumerate(edit.steps, start=1):
        change: Any = step.change
        for track in (getattr(change, "track", None), getattr(change, "other", None)):
            if track is not None and not any(copy.startswith(track) for copy in copies):
                yield EditReference(edit=name, step=f"step {number} ({step.kind})", track=track)
        copies += [change.name] if hasattr(change, "name") else []


def world_donors(config: Config, edit: Edit) -> dict[str, WorldDonor] | None:
    """The objects of synthetic worlds that an edit inserts, by the names of their assets; None where one is of no such
    world."""
    found = {}
    for name in asset_names(edit):
        asset = asset_of_results(name, "any")
        world = asset and asset[0] in config.scenes and config.datasets[config.dataset_of(asset[0])].world
        if not (asset and world):
            return None
        found[name] = WorldDonor(scene=asset[0], track=asset[2], world=world)
    return found


def refuse_wrong_tracks(
    config: Config,
    jobs: Iterable[Any],
    scene_file: Callable[[Any], str],
    keeps_tracks: Callable[[str], bool] = lambda _: False,
) -> None:
    """Raises ConfigError where one of Snakemake's planned `jobs` would fail on a track that the settings name. Records
    that this run makes are left to the stages `extract`, `relabel` and `actors`, which make the same check.

    `scene_file` gives the path of the scene record whose tracks a job shows by its wildcards; `keeps_tracks` tells of a
    scene whether a record that is made again has the same tracks as before.
    """
    planned = [job for job in jobs if hasattr(job.wildcards, "scene")]
    extracted = {job.wildcards.scene for job in planned if job.rule.name == "extract"}
    extracted = {scene for scene in extracted if not keeps_tracks(scene)}
    made = {str(job.output[0]) for job in planned if job.rule.name == "relabel"}
    for job in planned:
        rule, scene = job.rule.name, job.wildcards.scene
        if scene in extracted or rule not in (*RULES_OF_SUBJECT, *RULES_OF_EDITS):
            continue
        if scene_file(job.wildcards) in made:
            continue
        tracks = config.all_methods[job.wildcards.method].tracks
        references = track_references(config, scene, tracks=tracks)
        subject = references.subject if rule in RULES_OF_SUBJECT else None
        # the folder of a trajectory renders no edit
        of_edit = rule in RULES_OF_EDITS and getattr(job.wildcards, "kind", EDITS) == EDITS
        edit = (job.wildcards.drive if hasattr(job.wildcards, "drive") else job.wildcards.edit) if of_edit else None
        edits = tuple(one for one in references.edits if one.edit == edit)
        if subject is None and not edits:
            continue
        from drivesplat.scene.scene import read_scene
        from drivesplat.scene.track_references import refuse_unknown_tracks  # numpy; most runs name no tracks

        with suppress(ResultError):  # the job that reads this file reports it
            record = read_scene(scene_file(job.wildcards))
            refuse_unknown_tracks(TrackReferences(scene=scene, subject=subject, edits=edits), record)
