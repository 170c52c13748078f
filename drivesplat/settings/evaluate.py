"""Settings of the rules `lpips_backbone` and `evaluate`."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.lidar_depth import LidarDepthJob
from drivesplat.settings.tracks import Tracks
from drivesplat.settings.visuals import RemovalSettings

BACKBONE = "resources/lpips/alexnet.pth"
"""Path of LPIPS's AlexNet backbone. Without a network, users put the file there."""
BACKBONE_RECORD = "resources/lpips/backbone.json"
"""State of that file: its digest, or why it is missing."""


class LpipsSettings(Settings):
    enabled: bool = True
    """:printed: Compute LPIPS. Downloads the AlexNet backbone once. false: LPIPS is null and nothing is downloaded."""
    url: str = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
    """URL of the backbone. Without a network, put the file into resources/lpips."""
    sha256: str = Field("7be5be79", pattern="^[0-9a-f]{8,64}$")
    """SHA-256 of the file, or its first digits, as in PyTorch's file names."""
    timeout_s: float = Field(60.0, gt=0, le=3600)
    """Timeout of a silent connection (seconds)."""


class EvaluateJob(Settings):
    """All settings that determine one eval.json."""

    eval_camera: str
    cameras: tuple[str, ...]
    sweeps: bool
    holdout: HoldoutSettings
    lidar: LidarDepthJob
    """Settings of the LiDAR depth of held-out images, the same as for training images."""
    lpips: bool
    removal: RemovalSettings | None
    """Only for synthetic worlds: recorded drives have no ground truth without the vehicle."""
    tracks: Tracks = "annotated"
    """The tracks that the method was trained with."""


class EvaluateScansJob(Settings):
    """All settings that determine one eval.json of a scene without cameras."""

    holdout: HoldoutSettings
    tracks: Tracks = "annotated"
    """The tracks that the method was trained with."""
