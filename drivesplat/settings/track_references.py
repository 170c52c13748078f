"""The tracks that settings name."""

from drivesplat.settings import Settings


class EditReference(Settings):
    """A track that a step of an edit names."""

    edit: str
    """Name of the edit."""
    step: str
    """The step in messages: 'step 2 (stop)'."""
    track: str
    """Id of the track, or its beginning."""


class TrackReferences(Settings):
    """The tracks that the settings of a scene name. No settings of a stage: they are checked as soon as the scene's
    tracks are known, and used by later stages, of whose settings they are a part."""

    scene: str
    subject: str | None = None
    """Id of the vehicle of the ghost panel and of the removal. None: the workflow chooses it."""
    edits: tuple[EditReference, ...] = ()
