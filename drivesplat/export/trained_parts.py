"""The Gaussians of a trained model for exports: all at one time, or group by group with their motions and shapes.

Colours that vary with time are those of the time that static exports show. Gaussians with NaN or Inf are dropped, since
programs treat them differently.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.errors import ConfigError
from drivesplat.export.sampled_motion import SampledMotion, SampledShapes, sample_motion, shape_seconds
from drivesplat.io.storage import Provenance
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scene import Scene, Track

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class SampledGroup:
    """Gaussians in world coordinates or, with a `motion`, in the frame of the moving object; its `track` in the scene,
    if there is one; and the `shapes` of Gaussians that deform, which have that of the shown time."""

    gaussians: Gaussians
    motion: SampledMotion | None = None
    track: Track | None = None
    shapes: SampledShapes | None = None

    def of_rows(self, chosen: Bool[Tensor, " n"]) -> "SampledGroup":
        """The same with a part of its Gaussians, by mask."""
        if chosen.all():
            return self
        shapes, rows = self.shapes, chosen.cpu().numpy()
        if shapes is not None:
            shapes = replace(shapes, means=shapes.means[:, rows], quats=shapes.quats[:, rows])
        return replace(self, gaussians=self.gaussians[chosen], shapes=shapes)


def shown_timestamp(scene: Scene, time_s: float | None) -> int:
    """The timestamp (microseconds) that static exports show: `time_s` seconds after the first image, or with None that
    of the middle one of all images. Raises ConfigError for a time after the last image."""
    timestamps = np.sort([frame.timestamp for frame in scene.frames])
    if time_s is None:
        return int(timestamps[len(timestamps) // 2])
    shown = int(timestamps[0]) + round(time_s * 1e6)
    if shown > timestamps[-1]:
        raise ConfigError(
            f"export.time_s is {time_s}, but the last image of scene {scene.name} is at "
            f"{scene.seconds(timestamps[-1]):.2f} s: choose a time within the drive"
        )
    return shown


@torch.no_grad()
def trained_gaussians(model: SplatModel, scene: Scene, time_s: float | None = None) -> Gaussians:
    """All Gaussians of a model in world coordinates at the shown time (`shown_timestamp`), except those of absent
    objects."""
    gaussians = model.at(scene.seconds(shown_timestamp(scene, time_s)))
    return gaussians[_finite(gaussians, "all parts together") & ((gaussians.opacities != 0) | ~model.moving())]


@torch.no_grad()
def trained_groups(
    model: SplatModel, scene: Scene, timestamps: np.ndarray, time_s: float | None = None
) -> dict[str, SampledGroup]:
    """The rigid groups of a model by name, objects in their own frames, present or not.

    Their motions are sampled at `timestamps` (m,) of images (microseconds), among others. `time_s` is the shown time
    (`shown_timestamp`).
    """
    shown = scene.seconds(shown_timestamp(scene, time_s))
    recorded = (timestamps - min(frame.timestamp for frame in scene.frames)) * 1e-6
    result: dict[str, SampledGroup] = {}
    for name, group in model.rigid_groups(shown).items():
        found = SampledGroup(group.gaussians)
        if group.motion is not None:
            motion = sample_motion(group.motion, recorded, shown)
            found = replace(found, motion=motion, track=scene.track(name), shapes=sampled_shapes(model, name, motion))
        result[name] = found.of_rows(_finite(group.gaussians, name))
    return result


def sampled_shapes(model: SplatModel, track_id: str, motion: SampledMotion) -> SampledShapes | None:
    """The shapes of an object of a model while it is present; None for a rigid one."""
    seconds = shape_seconds(motion)
    of_parts = (part.shapes(track_id, seconds.tolist()) for part in model.parts)
    shapes = next((found for found in of_parts if found is not None), None)
    return None if shapes is None else SampledShapes(seconds, *(values.cpu().numpy() for values in shapes))


def digests(provenance: Provenance) -> dict[str, str]:
    """The digests of a provenance, for files with little space."""
    return {name: provenance[name] for name in ("settings_sha256", "code_sha256", "inputs_sha256")}


def _finite(gaussians: Gaussians, name: str) -> Bool[Tensor, " n"]:
    """The mask of Gaussians without NaN or Inf; a warning names the others' number."""
    values = [value.isfinite().reshape(len(gaussians), -1).all(dim=1) for value in gaussians.tensors.values()]
    finite = torch.stack(values).all(dim=0)
    if not finite.all():
        dropped = int((~finite).sum())
        log.warning("%s: %d of %d Gaussians contain NaN or Inf and are dropped", name, dropped, len(finite))
    return finite
