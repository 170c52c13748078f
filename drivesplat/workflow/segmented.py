"""Maps by a network among the masks of a scene: which they replace, and where they lie."""

from drivesplat.settings.config import Config
from drivesplat.settings.masks import MaskSettings
from drivesplat.settings.segment import DEFAULT, SegmentJob, model_name

SEGMENTED = "segmented"
"""The folder of the maps, below that of a scene's results."""


def segment_job(config: Config) -> SegmentJob:
    """The settings of a scene's maps, given the config that applies to it."""
    found = config.segment
    model = model_name(found.model or DEFAULT)
    return SegmentJob(model=model, labels=found.labels, height=found.height, images=config.images)


def replaced_masks(config: Config) -> list[str]:
    """The kinds of masks that maps by a network replace: those in use that have no folder of the user's."""
    used = config.segment.use if config.segment.model else ()
    return [kind for kind in used if getattr(config.masks, f"{kind}_folder") is None]


def mask_settings(config: Config, scene: str) -> MaskSettings:
    """The settings of a scene's masks, with the folders of the maps that replace some. The folder's name is a digest of
    the settings of the maps: with others the masks are made again."""
    kinds = replaced_masks(config)
    if not kinds:
        return config.masks
    folder = f"{config.results_dir}/{scene}/{SEGMENTED}/{segment_job(config).folder}"
    return config.masks.model_copy(update={f"{kind}_folder": f"{folder}/{kind}" for kind in kinds})
