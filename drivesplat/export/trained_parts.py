"""The Gaussians of a trained model for exports: all at one time, or rigid group by rigid group with their motions.

Colours that vary with time are those of the drive's middle image. Gaussians with NaN or Inf are dropped, since programs
treat them differently.
"""

import logging
from dataclasses import dataclass

import numpy as np
import torch

from drivesplat.export.sampled_motion import SampledMotion, sample_motion
from drivesplat.io.storage import Provenance
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scene import Scene, Track

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SampledGroup:
    """Gaussians in world coordinates or, with a `motion`, in the frame of the moving object; its `track` in the scene,
    if there is one."""

    gaussians: Gaussians
    motion: SampledMotion | None = None
    track: Track | None = None


def middle_timestamp(scene: Scene) -> int:
    """The timestamp (microseconds) of the middle one of all images: the time of static exports."""
    return int(np.sort([frame.timestamp for frame in scene.frames])[len(scene.frames) // 2])


@torch.no_grad()
def trained_gaussians(model: SplatModel, scene: Scene) -> Gaussians:
    """All Gaussians of a model in world coordinates at the time of the middle image, except those of absent objects."""
    gaussians = model.gaussians_at(scene.seconds(middle_timestamp(scene)))
    return _finite(gaussians[(gaussians.opacities != 0) | ~model.moving()], "all parts together")


@torch.no_grad()
def trained_groups(model: SplatModel, scene: Scene, timestamps: np.ndarray) -> dict[str, SampledGroup]:
    """The rigid groups of a model by name, objects in their own frames, present or not.

    Their motions are sampled at `timestamps` (m,) of images (microseconds), among others.
    """
    middle = scene.seconds(middle_timestamp(scene))
    recorded = (timestamps - min(frame.timestamp for frame in scene.frames)) * 1e-6
    result: dict[str, SampledGroup] = {}
    for name, group in model.rigid_groups(middle).items():
        motion = None if group.motion is None else sample_motion(group.motion, recorded, middle)
        track = None if group.motion is None else scene.track(name)
        result[name] = SampledGroup(_finite(group.gaussians, name), motion, track)
    return result


def digests(provenance: Provenance) -> dict[str, str]:
    """The digests of a provenance, for files with little space."""
    return {name: provenance[name] for name in ("settings_sha256", "code_sha256", "inputs_sha256")}


def _finite(gaussians: Gaussians, name: str) -> Gaussians:
    values = [value.isfinite().reshape(len(gaussians), -1).all(dim=1) for value in gaussians.tensors.values()]
    finite = torch.stack(values).all(dim=0)
    if finite.all():
        return gaussians
    log.warning("%s: %d of %d Gaussians contain NaN or Inf and are dropped", name, int((~finite).sum()), len(finite))
    return gaussians[finite]
