"""What the stage `refine_poses` may be told."""

from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.lidar_depth import Degrees


class FeatureSettings(Settings):
    """SIFT features of the key frames' images, and which images they are looked for in."""

    max_image_size: int = Field(1600, ge=64, le=8192)
    """Images larger than this (pixels, the longer side) are reduced before features are looked for."""
    max_features: int = Field(4096, ge=64, le=65_536)
    """Most features of an image."""
    neighbours: int = Field(6, ge=1, le=100)
    """Features are matched with those of so many key frames that follow, seen by the same camera."""
    across: int = Field(2, ge=0, le=100)
    """Of cameras whose views overlap, key frames up to so far apart are matched as well."""
    box_margin: float = Field(0.3, ge=0, le=5)
    """Boxes of what moves are grown by this (metres) before the features in them are left out."""


class PriorSettings(Settings):
    """How far off the given poses are expected to be. Standard deviations."""

    position: float = Field(0.05, gt=0)
    """Of horizontal positions, in metres."""
    height: float = Field(0.1, gt=0)
    """Of heights, in metres: nuScenes gives none."""
    tilt: float = Field(0.02, gt=0)
    """Of roll and pitch, in radians."""
    heading: float = Field(0.005, gt=0)
    """Of the heading, in radians."""
    drift: float = Field(0.25, gt=0)
    """How much of these the error changes by within a second: what is wrong with poses changes slowly."""


class LimitSettings(Settings):
    """When a refinement is not believed, and the given poses are kept, with a warning that says which limit it was. Of
    these, `start: images` knows min_points, min_images and max_scale_drift, and stops there."""

    max_shift: float = Field(0.5, gt=0)
    """Largest correction of a position, in metres."""
    max_turn: float = Field(3.0, gt=0)
    """Largest correction of a rotation, in degrees."""
    min_points: int = Field(30, ge=3)
    """An image that sees fewer triangulated points than this has nothing to hold on to."""
    min_images: float = Field(0.7, ge=0, le=1)
    """So large a share of the images must have something to hold on to; the others follow their neighbours. With
    `start: images`, of the key frames."""
    min_gain: float = Field(0.05, ge=0, lt=1)
    """By so large a share the median error of points that took no part must fall: less is the features' noise."""
    max_scale_drift: float = Field(1.2, ge=1)
    """With `start: images`, the largest factor by which the scale may change along the drive; images whose own differs
    more from those around them follow these."""


class RefinePosesSettings(Settings):
    """Poses corrected by what the images show: features matched between neighbouring images and triangulated, then
    bundle adjustment with the given poses as priors, all cameras as one rig, intrinsics fixed."""

    enabled: Literal["auto", True, False] = "auto"
    """Whether every later stage takes the refined poses. 'auto': those of recorded drives, and of synthetic worlds with
    pose_noise; where they cannot be refined, the given ones are kept, with a warning. true insists on pycolmap."""
    start: Literal["recorded", "images"] = "recorded"
    """Where poses start from: 'recorded' corrects those of the dataset; 'images' makes poses from images alone, for
    drives that have none, and stops where the drive does not allow it. docs/poses.md"""
    features: FeatureSettings = FeatureSettings()
    priors: PriorSettings = PriorSettings()
    limits: LimitSettings = LimitSettings()
    min_angle: float = Field(1.0, gt=0, le=90)
    """Rays that meet under a smaller angle than this (degrees) make no point."""
    feature_noise: float = Field(0.3, gt=0)
    """How far off (pixels of the recorded image) features are found: what images are trusted by against the priors."""
    robust_pixels: float = Field(1.0, gt=0)
    """Reprojection errors well beyond this (pixels) hardly count (Cauchy's loss)."""
    rounds: int = Field(3, ge=1, le=20)
    """How often points are triangulated anew with the poses so far, and both adjusted."""
    withheld: float = Field(0.1, ge=0.01, le=0.5)
    """So large a share of the points takes no part in a trial adjustment, which is judged by them: where poses do not
    serve them better than the given ones, the given ones are kept."""


class LidarRays(Settings):
    """What LiDAR's returns in an image are read by."""

    ray_spacing: tuple[Degrees, Degrees]
    own_car_radius: float


class RefinePosesJob(Settings):
    """Everything that decides the content of one scene_refined.json, the scene aside."""

    refine_poses: RefinePosesSettings
    random_seed: int
    lidar: LidarRays | None = None
    """None where poses start from the recorded ones: nothing is asked of LiDAR."""
