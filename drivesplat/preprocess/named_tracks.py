"""The stage `named_tracks`: refuses wrong ids of tracks before any training."""

from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import moving_tracks, short_ids
from drivesplat.settings.named_tracks import NamedTracks
from drivesplat.settings.names import suggestion

TABLE = "tracks.csv lists all tracks"


def check_named_tracks(scene: Scene, named: NamedTracks) -> dict[str, Any]:
    """The content of named_tracks.json without provenance: the ids that each named track may stand for.

    Raises ConfigError, naming edit and step, where an edit names no track that moves, or the subject is no track.
    """
    moving, known = [track.id for track in moving_tracks(scene)], [track.id for track in scene.tracks]
    found: dict[str, dict[str, list[str]]] = {}
    for edit, steps in named.edits.items():
        for step, start in steps.items():
            found.setdefault(edit, {})[step] = [name for name in moving if name.startswith(start)]
            if not found[edit][step]:
                standing = " that moves" if any(name.startswith(start) for name in known) else ""
                there = ", ".join(short_ids(moving).values()) or "none"
                raise ConfigError(
                    f"scene {scene.name}, edit {edit!r}, {step}: no track{standing} has an id starting with {start!r}; "
                    f"moving tracks: {there} ({TABLE})"
                )
    if named.subject is not None and named.subject not in known:
        meant = suggestion(named.subject, moving)
        there = ", ".join(moving) or "none"
        raise ConfigError(
            f"subjects.{scene.name}: there is no track {named.subject!r}; {meant}moving tracks: {there} ({TABLE})"
        )
    return {"edits": found, "subject": named.subject}
