"""What of a training leaves the workflow: its Gaussians at one time, and where they come from in short."""

import logging
from typing import Any

import numpy as np
import torch

from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene import Scene

log = logging.getLogger(__name__)


@torch.no_grad()
def trained_parts(model: SplatModel, scene: Scene) -> dict[str, Gaussians]:
    """The Gaussians of a model's parts by their names, at the time of the scene's middle image.

    Those with a value that is not finite are left out: every program makes something else of them.
    """
    middle = np.sort([frame.timestamp for frame in scene.frames])[len(scene.frames) // 2]
    return {part.name: _finite(part.at(scene.seconds(middle)), part.name) for part in model.parts}


def digests(provenance: dict[str, Any]) -> dict[str, str]:
    """Of a provenance what fits where there is little room."""
    return {name: provenance[name] for name in ("settings_sha256", "code_sha256", "inputs_sha256")}


def _finite(gaussians: Gaussians, name: str) -> Gaussians:
    values = [value.isfinite().reshape(len(gaussians), -1).all(dim=1) for value in vars(gaussians).values()]
    finite = torch.stack(values).all(dim=0)
    if finite.all():
        return gaussians
    log.warning("%s: %d of %d Gaussians are not finite and left out", name, int((~finite).sum()), len(finite))
    return gaussians[finite]
