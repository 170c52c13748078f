"""What the stages `lpips_backbone` and `evaluate` may be told."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.inspection import RemovalSettings
from drivesplat.settings.lidar_depth import LidarDepthJob

BACKBONE = "resources/lpips/alexnet.pth"
"""Where LPIPS's AlexNet backbone is kept; users without network put it there themselves."""
BACKBONE_RECORD = "resources/lpips/backbone.json"
"""What is known of that file."""


class LpipsSettings(Settings):
    enabled: bool = True
    """Measure LPIPS. Needs the AlexNet backbone, fetched once; false = null, and nothing is fetched."""
    url: str = "https://download.pytorch.org/models/alexnet-owt-7be5be79.pth"
    """Where the backbone is fetched from. Without network: put the file into resources/lpips yourself."""
    sha256: str = Field("7be5be79", pattern="^[0-9a-f]{8,64}$")
    """The file's SHA-256, or its first digits, as in PyTorch's file names."""
    timeout_s: float = Field(60.0, gt=0, le=3600)
    """Longest silence of the server in seconds."""


class EvaluateJob(Settings):
    """Everything that decides the content of one eval.json, its inputs aside."""

    eval_camera: str
    cameras: tuple[str, ...]
    sweeps: bool
    holdout: HoldoutSettings
    lidar: LidarDepthJob
    """What LiDAR of held-out sweeps says of depth is found out as it is for training images."""
    lpips: bool
    removal: RemovalSettings | None
    """For synthetic worlds: recorded drives have no truth that a removal could be held to."""
