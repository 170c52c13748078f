"""The tracks that the settings of a scene name: in its edits and as its subject."""

from collections.abc import Mapping

from drivesplat.settings import Settings
from drivesplat.settings.edit import Edit


class NamedTracks(Settings):
    """All settings that determine one named_tracks.json."""

    scene: str
    edits: dict[str, dict[str, str]]
    """The start of the id of each track that an edit names, by edit and step: {stop: {"step 1 (stop)": 6e5c}}."""
    subject: str | None = None
    """The id of the track under `subjects`."""

    @property
    def any(self) -> bool:
        """Whether a track is named at all."""
        return bool(self.edits) or self.subject is not None


def tracks_of_steps(edit: Edit) -> dict[str, str]:
    """The tracks that the steps of an edit name, by step, without copies that earlier steps made."""
    named: dict[str, str] = {}
    copies: set[str] = set()
    for number, step in enumerate(edit.steps, start=1):
        change = step.change
        for key in ("track", "other"):
            track = getattr(change, key, None)
            if track is not None and not any(copy.startswith(track) for copy in copies):
                other = " with" if key == "other" else ""
                named[f"step {number} ({step.kind}{other})"] = track
        if step.duplicate or step.place:
            copies.add(change.name)
    return named


def named_tracks(scene: str, edits: Mapping[str, Edit], subject: str | None) -> NamedTracks:
    """The tracks that the `edits` of a scene and its `subject` name."""
    by_edit = {name: tracks_of_steps(edit) for name, edit in edits.items()}
    return NamedTracks(scene=scene, edits={name: steps for name, steps in by_edit.items() if steps}, subject=subject)
