"""Settings of the rule `segment`, which makes class maps and sky masks by a network."""

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Literal

from pydantic import Field

from drivesplat.settings import Settings
from drivesplat.settings.images import ImageSettings

MapKind = Literal["sky", "semantic", "regions"]
LabelSetName = Literal["cityscapes", "mapillary", "ade20k"]
DEFAULT = "default"
DEFAULT_MODEL = "openmmlab/upernet-convnext-small"
"""The model that is called `default`: weights under the MIT licence, trained on ADE20K."""


class SegmentSettings(Settings):
    """Class maps and sky masks of all images by a segmentation network. docs/masks.md"""

    model: str | None = None
    """:printed: Network: 'default', a name on Hugging Face (owner/name), a folder with the files of a model, or an
    .onnx file. null = none: the sky is found by a heuristic. docs/masks.md"""
    use: tuple[MapKind, ...] = ("sky",)
    """What its maps replace where masks.sky_folder, masks.semantic_folder or masks.regions_folder is not set: 'sky',
    'semantic' (class maps for train.semantic_weight), 'regions' (labels from boxes, left out of all metrics but `all`
    where the map contradicts)."""
    labels: LabelSetName | None = None
    """Label set of the network. null = as its labels are called, else as many as it has."""
    height: int | None = Field(512, ge=64, le=4096)
    """Height in pixels of the images that the network sees, rounded to a multiple of 32; the width follows. null = the
    size that its files state."""


def model_name(model: str) -> str:
    """The name on Hugging Face of a model that may be called `default`."""
    return DEFAULT_MODEL if model == DEFAULT else model


def local_path(model: str) -> Path | None:
    """The folder or the .onnx file of a model of this machine; None for a name on Hugging Face."""
    path = Path(model).expanduser()
    local = path.suffix == ".onnx" or model.startswith((".", "/", "~")) or path.is_dir()
    return path if local and model != DEFAULT else None


class SegmentJob(Settings):
    """All settings that determine the maps of one scene."""

    model: str
    labels: LabelSetName | None
    height: int | None
    images: ImageSettings

    @cached_property
    def folder(self) -> str:
        """The name of the folder of these maps: a digest of the settings."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:8]
