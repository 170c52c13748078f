"""What the stage `masks` may be told."""

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.ego_mask import OwnCarKind
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings


class MaskSettings(Settings):
    regions_folder: str | None = None
    """Your own label images (labels as in drivesplat/scene/regions.py), named {camera}/{image name}.png. null = from
    the annotated boxes."""
    sky_folder: str | None = None
    """Your own sky masks (255 = sky), named {camera}/{image name}.png. null = a heuristic."""
    semantic_folder: str | None = None
    """Your own maps of classes (0, 1, 2, ...; 255 = unlabelled), named {camera}/{image name}.png: what
    train.semantic_weight holds trainings to. null = there are none."""
    own_car: OwnCarKind = "auto"
    """Where the own car's body is seen, which no region holds and no training learns: 'polygons' (where
    own_car_polygons says), 'auto' (there; for cameras without an outline where images stay as they are while the car
    drives, but for eval_camera, whose figures hang on no guess), 'auto_measured' (for eval_camera, too) or 'none'."""
    own_car_polygons: dict[str, tuple[tuple[float, float], ...]] = Field(default_factory=dict)
    """Per camera the outline of the own car's body, as x, y in fractions of the image's width and height."""


class MaskJob(Settings):
    """Everything that decides the content of one masks folder, the scene aside."""

    masks: MaskSettings
    holdout: HoldoutSettings
    images: ImageSettings
