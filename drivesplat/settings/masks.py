"""Settings of the rules `masks` and `own_car`, which finds the ego vehicle's body in images."""

from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.images import HoldoutSettings, ImageSettings

EgoMaskKind = Literal["none", "polygons", "auto", "auto_measured"]


class MaskSettings(Settings):
    regions_folder: str | None = None
    """:printed: Folder of your own label images, {camera}/{image name}.png or {camera}/{timestamp}.png. null = regions
    from the annotated boxes. docs/masks.md"""
    sky_folder: str | None = None
    """:printed: Folder of your own sky masks (255 = sky), with files of the same names. null = a heuristic."""
    semantic_folder: str | None = None
    """:printed: Folder of your own class maps (0, 1, 2, ...; 255 = unlabelled), with files of the same names, for
    train.semantic_weight. null = none."""
    own_car: EgoMaskKind = "auto"
    """:printed: Mask of the ego vehicle's body, which is excluded from training and from all regions. 'polygons': the
    outlines of own_car_polygons. 'auto': these, and for cameras without an outline, except eval_camera, the image area
    that does not change while the vehicle drives. 'auto_measured': the same with eval_camera. 'none': no mask.
    docs/cameras.md"""
    own_car_polygons: dict[str, tuple[tuple[float, float], ...]] = Field(default_factory=dict)
    """:printed: Outline of the ego vehicle's body, by camera: points x, y in fractions of the image's width and
    height."""


class MaskJob(Settings):
    """All settings that determine the masks of one scene."""

    masks: MaskSettings
    holdout: HoldoutSettings
    images: ImageSettings


class RegionJob(Settings):
    """All settings that determine the regions by other tracks of one scene."""

    images: ImageSettings


class EgoMaskSearch(Settings):
    """Search for the ego vehicle's body in the images of `cameras`."""

    cameras: tuple[str, ...]
    holdout: HoldoutSettings
    own_car_radius: float
    """Horizontal distance from the LiDAR (metres) within which returns belong to the ego vehicle."""


class EgoMaskJob(Settings):
    """All settings that determine the own_car.json of one scene."""

    polygons: dict[str, tuple[tuple[float, float], ...]]
    search: EgoMaskSearch | None
    """None: polygons only."""
