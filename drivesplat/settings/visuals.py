"""Settings of the track table, the ghost panel and the removal of a vehicle."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.actor_seed import ActorSeedSettings


class SubjectSettings(Settings):
    """The vehicle of the ghost panel and of the removal."""

    track: str | None = None
    """Id of its track (tracks.csv lists them). null = the moving vehicle that fills most pixels."""
    key_frame: int | None = Field(None, ge=0)
    """Key frame to show. null = the key frame in which the vehicle fills most pixels."""


class GhostSettings(Settings):
    """Ghosts: Gaussians in the volume that a moving box sweeps, but outside the box at the time of the image."""

    clearance: float = Field(0.2, ge=0, le=2)
    """Height above the floor of the box (metres) below which Gaussians count as road, not as ghosts."""


class RemovalSettings(Settings):
    """Removal of a vehicle from a model without actors: the Gaussians in its box are removed."""

    margin: float = Field(0.1, ge=0, le=2)
    """Margin around the sides and the roof of the box (metres) in which Gaussians are removed, too. The floor has no
    margin, since the road is below it."""


class TracksJob(Settings):
    """All settings that determine one tracks.csv."""

    eval_camera: str
    actors: ActorSeedSettings


class PanelJob(Settings):
    """All settings that determine one ghost panel."""

    eval_camera: str
    subject: SubjectSettings
    ghosts: GhostSettings


class RemovalJob(PanelJob):
    """All settings that determine one removal."""

    removal: RemovalSettings
