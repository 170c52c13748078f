"""What of a training leaves the workflow: its Gaussians as they stand at one time, or group by group with the motion of
each; and where they come from in short.

Colours that vary with time are those of the drive's middle image. Gaussians with a value that is not finite are left
out: every program makes something else of them.
"""

import logging
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from drivesplat.export.sampled_motion import SampledMotion, sampled
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scene import Scene, Track

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SampledGroup:
    """Gaussians in world coordinates, or, where there is a `motion`, in the frame of the object that moves so.

    `track` is what the scene knows of that object, if it does.
    """

    gaussians: Gaussians
    motion: SampledMotion | None = None
    track: Track | None = None


def middle_timestamp(scene: Scene) -> int:
    """When (microseconds) the middle one of all images was taken: the time of exports that know none."""
    return int(np.sort([frame.timestamp for frame in scene.frames])[len(scene.frames) // 2])


@torch.no_grad()
def trained_gaussians(model: SplatModel, scene: Scene) -> Gaussians:
    """All Gaussians of a model in world coordinates at the time of the middle image, but those of absent objects."""
    gaussians = model.gaussians_at(scene.seconds(middle_timestamp(scene)))
    return _finite(gaussians[(gaussians.opacities != 0) | ~model.moving()], "all parts together")


@torch.no_grad()
def trained_groups(model: SplatModel, scene: Scene, timestamps: np.ndarray) -> dict[str, SampledGroup]:
    """The groups of a model by their names, objects in their own frames, whether they are there then or not.

    Their motions are sampled at the `timestamps` (m,) of images (microseconds), among others.
    """
    middle = scene.seconds(middle_timestamp(scene))
    recorded = (timestamps - min(frame.timestamp for frame in scene.frames)) * 1e-6
    found: dict[str, SampledGroup] = {}
    for name, group in model.rigid_groups(middle).items():
        motion = None if group.motion is None else sampled(group.motion, recorded, middle)
        track = None if group.motion is None else scene.track(name)
        found[name] = SampledGroup(_finite(group.gaussians, name), motion, track)
    return found


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
