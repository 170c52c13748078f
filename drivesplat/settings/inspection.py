"""The vehicle that is looked at: its ghosts, and what is left when it is removed."""

from pydantic import Field

from drivesplat.settings import Settings


class SubjectSettings(Settings):
    """The vehicle of a scene that the ghost panel shows and that is removed."""

    track: str | None = None
    """The id of its track (scene.json lists them). null = of what moves, the one that fills most pixels."""
    key_frame: int | None = Field(None, ge=0)
    """The key frame at which it is looked at. null = the one in which it fills most pixels."""


class GhostSettings(Settings):
    """Ghosts: Gaussians in the volume that a moving box swept, outside the box at the moment looked at."""

    clearance: float = Field(0.2, ge=0, le=2)
    """What lies lower over the box's floor than this (metres) is road, not ghost."""


class RemovalSettings(Settings):
    """The removal of a vehicle from a trained model that does not know it as an object: by its box."""

    margin: float = Field(0.1, ge=0, le=2)
    """Gaussians whose centres are nearer than this (metres) to the box's sides or roof are removed, too; its floor
    stays where it is, since below it is road."""


class TracksJob(Settings):
    """Everything that decides the content of one tracks.csv, its inputs aside."""

    eval_camera: str


class PanelJob(Settings):
    """Everything that decides the content of one ghost panel, its inputs aside."""

    eval_camera: str
    subject: SubjectSettings
    ghosts: GhostSettings


class RemovalJob(Settings):
    """Everything that decides the content of one removal, its inputs aside."""

    eval_camera: str
    subject: SubjectSettings
    ghosts: GhostSettings
    removal: RemovalSettings
