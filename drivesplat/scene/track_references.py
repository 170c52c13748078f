"""The check of the tracks that settings name, as soon as a scene's tracks are known. The stages that use them come
after the training."""

from collections.abc import Iterable, Sequence

from drivesplat.errors import ConfigError
from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import moving_tracks, short_ids
from drivesplat.settings.names import suggestion
from drivesplat.settings.track_references import TrackReferences


def why_fixed(name: str, ids: Iterable[str]) -> str:
    """The end of a message on a track that an edit names and that is not editable: empty unless one of `ids` begins
    with the `name`."""
    there = any(track.startswith(name) for track in ids)
    return "; the method has no Gaussians of this track alone (people need presets/people.yaml)" if there else ""


def refuse_unknown_tracks(references: TrackReferences, scene: Scene) -> None:
    """Raises ConfigError where the settings name a track that the scene does not have."""
    ids, moving = [track.id for track in scene.tracks], [track.id for track in moving_tracks(scene)]
    if references.subject is not None and references.subject not in ids:
        started = [name for name in ids if name.startswith(references.subject)]
        meant = f"did you mean {started[0]}? " if len(started) == 1 else suggestion(references.subject, ids)
        raise ConfigError(
            f"subjects.{scene.name}: the scene has no track {references.subject!r}; {meant}"
            f"tracks that move: {', '.join(moving) or 'none'}"
        )
    _refuse_unknown_edits(references, scene, ids, "no track has", "tracks that move", moving)


def refuse_fixed_tracks(references: TrackReferences, scene: Scene, editable: Sequence[str]) -> None:
    """Raises ConfigError where an edit names a track that is not among the ids of the `editable` ones."""
    _refuse_unknown_edits(references, scene, editable, "no editable track has", "editable tracks", editable)


def _refuse_unknown_edits(
    references: TrackReferences, scene: Scene, known: Sequence[str], none_has: str, kind: str, listed: Sequence[str]
) -> None:
    for named in references.edits:
        if not any(name.startswith(named.track) for name in known):
            short = ", ".join(short_ids(listed).values()) or "none"
            fixed = why_fixed(named.track, (track.id for track in scene.tracks))
            raise ConfigError(
                f"scene {scene.name}, edit {named.edit!r}, {named.step}: {none_has} an id starting with "
                f"{named.track!r}; {kind}: {short}{fixed}"
            )
