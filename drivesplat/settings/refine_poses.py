"""Settings of the rule `refine_poses`."""

from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.lidar_depth import Degrees


class FeatureSettings(Settings):
    """Detection and matching of SIFT features in key-frame images."""

    max_image_size: int = Field(1600, ge=64, le=8192)
    """Maximum length of the longer image side (pixels). Larger images are reduced before detection."""
    max_features: int = Field(4096, ge=64, le=65_536)
    """Maximum number of features per image."""
    neighbours: int = Field(6, ge=1, le=100)
    """Number of later key frames of the same camera that an image is matched with: the next one, and those at
    multiples of `spacing`."""
    spacing: float = Field(2.5, ge=0)
    """Distance (metres along the path) between these key frames. Where key frames are farther apart, or with 0, they
    are the following ones."""
    across: int = Field(2, ge=0, le=100)
    """Maximum distance in key frames between matched images of different cameras with overlapping views."""
    box_margin: float = Field(0.3, ge=0, le=5)
    """Margin (metres) around boxes of moving objects in which features are left out."""


class PriorSettings(Settings):
    """Expected errors (standard deviations) of the given poses."""

    position: float = Field(0.05, gt=0)
    """Horizontal position (metres)."""
    height: float = Field(0.1, gt=0)
    """Height (metres). nuScenes' ego poses have none."""
    tilt: float = Field(0.02, gt=0)
    """Roll and pitch (radians)."""
    heading: float = Field(0.005, gt=0)
    """Heading (radians)."""
    drift: float = Field(0.25, gt=0)
    """Change of the error within one second, as a fraction of the above: pose errors change slowly."""


class RegisteredPriorSettings(PriorSettings):
    """The same of poses whose LiDAR sweeps were registered to each other."""

    position: float = Field(0.01, gt=0)
    """Horizontal position (metres)."""
    height: float = Field(0.01, gt=0)
    """Height (metres)."""
    tilt: float = Field(0.001, gt=0)
    """Roll and pitch (radians)."""
    heading: float = Field(0.0007, gt=0)
    """Heading (radians)."""


class LimitSettings(Settings):
    """Limits beyond which a refinement is rejected: the given poses are kept and a warning names the limit. With
    `start: images` only min_points, min_images and max_scale_drift apply, and the rule fails."""

    max_shift: float = Field(0.5, gt=0)
    """Maximum correction of a position (metres)."""
    max_turn: float = Field(3.0, gt=0)
    """Maximum correction of a rotation (degrees)."""
    min_points: int = Field(30, ge=3)
    """Minimum number of triangulated points for an image to count as constrained."""
    min_images: float = Field(0.7, ge=0, le=1)
    """Minimum fraction of images (with `start: images`, of key frames) that must be constrained. The others are
    interpolated from their neighbours."""
    min_gain: float = Field(0.05, ge=0, lt=1)
    """Minimum relative decrease of the median reprojection error of withheld points."""
    max_stretch: float = Field(0.01, gt=0, lt=1)
    """Maximum relative change of the length of the path. Applies where no LiDAR agrees with it."""
    max_scale_drift: float = Field(1.2, ge=1)
    """Maximum factor by which the scale may change along the drive, with `start: images`. Images whose scale deviates
    more from their neighbours' are interpolated."""


class RefinePosesSettings(Settings):
    """Refinement of the recorded poses from images: features of neighbouring images are matched and triangulated, then
    bundle adjustment corrects the poses with the given poses as priors, all cameras as one rig, and fixed intrinsics.
    """

    enabled: Literal["auto", True, False] = "auto"
    """:printed: Use refined poses in all later stages. 'auto': for recorded drives and for synthetic worlds with
    pose_noise; where refinement is impossible or rejected, the given poses are kept with a warning. true: fail without
    pycolmap."""
    start: Literal["recorded", "images"] = "recorded"
    """:printed: Initial poses: 'recorded' corrects the dataset's poses; 'images' estimates poses from the images alone,
    for drives without poses, and fails where the drive does not allow it. docs/poses.md"""
    features: FeatureSettings = FeatureSettings()
    priors: PriorSettings = PriorSettings()
    priors_with_lidar: RegisteredPriorSettings = RegisteredPriorSettings()
    """The same for images, of drives whose LiDAR sweeps are registered to each other first."""
    limits: LimitSettings = LimitSettings()
    min_angle: float = Field(1.0, gt=0, le=90)
    """Minimum angle between the rays of a triangulated point (degrees)."""
    feature_noise: float = Field(0.3, gt=0)
    """Expected error of feature positions (pixels of the recorded image). It weighs images against the priors."""
    robust_pixels: float = Field(1.0, gt=0)
    """Scale of the Cauchy loss of reprojection errors (pixels)."""
    rounds: int = Field(3, ge=1, le=20)
    """Number of rounds of triangulation and adjustment."""
    withheld: float = Field(0.1, ge=0.01, le=0.5)
    """Fraction of the points that are withheld from a trial adjustment and then judge it: unless their error falls by
    limits.min_gain, the given poses are kept."""

    @property
    def paired_features(self) -> FeatureSettings:
        """`features` with neighbours of a drive whose recorded positions say nothing, if they are not used."""
        return self.features if self.start == "recorded" else self.features.model_copy(update={"spacing": 0.0})


class LidarRays(Settings):
    """Settings for LiDAR depth at image points."""

    ray_spacing: tuple[Degrees, Degrees]
    own_car_radius: float


class RefinePosesJob(Settings):
    """All settings that determine the scene_refined.json of one scene."""

    refine_poses: RefinePosesSettings
    random_seed: int
    lidar: LidarRays | None = None
    """None: LiDAR takes no part."""
