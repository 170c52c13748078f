"""What the stage `parser` may be told."""

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings


class ParserJob(Settings):
    """Everything that decides the content of one parser.pkl, scene and seed aside."""

    holdout: HoldoutSettings
    images: ImageSettings
