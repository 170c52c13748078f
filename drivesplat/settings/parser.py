"""Settings of the rule `parser`."""

from drivesplat.settings import Settings
from drivesplat.settings.holdout import HoldoutSettings
from drivesplat.settings.images import ImageSettings


class ParserJob(Settings):
    """All settings that determine the parser.pkl of one scene."""

    holdout: HoldoutSettings
    images: ImageSettings
