"""Deformations as a few modes, for viewers: shapes are linear in weights that depend on the gait and on time.

The weights of a model (`Part.shape_weights`) are nearly dependent where an object was seen for a short time. Modes are
therefore fitted for orthonormal combinations of them, which coarsely stored modes do not amplify. Combinations that
vary little over the drive are left out.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from drivesplat.export.sampled_motion import SampledShapes
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement

MIN_SHARE = 0.03
"""Of the singular values of the sampled weights, relative to the largest: smaller ones are noise."""
MIN_COSINE = 0.1
"""Of half a rotation, for finite vectors: half a turn has none."""


@dataclass(frozen=True)
class Gait:
    """What the limbs of an object follow at n times: `seconds` (n,) since the first image; the length `walked` (n,) of
    its path in metres (None: as recorded); its `scale`; and the cycles of the gait by which it is ahead (`phase`)."""

    seconds: Float[np.ndarray, " n"]
    walked: Float[np.ndarray, " n"] | None = None
    scale: float = 1.0
    phase: float = 0.0


@dataclass(frozen=True)
class Modes:
    """How n Gaussians deviate from the shape that a group shows, in the object's frame: sums of m modes, times weights.
    `shifts` (m, n, 3) in metres; `turns` (m, n, 3), rotation vectors: the sum t stands for the quaternion (1, t),
    normalised. `weights` gives those (t, m) of a gait."""

    shifts: Float[np.ndarray, "m n 3"]
    turns: Float[np.ndarray, "m n 3"]
    weights: Callable[[Gait], Float[np.ndarray, "t m"]]


def fitted_modes(model: SplatModel, groups: Mapping[str, SampledGroup]) -> dict[str, Modes]:
    """The modes of the groups that deform and have Gaussians, by name, fitted to their sampled shapes."""
    return {
        name: _fitted(model, name, group.gaussians, group.shapes)
        for name, group in groups.items()
        if group.shapes is not None and len(group.gaussians)
    }


def _fitted(model: SplatModel, name: str, shown: Gaussians, shapes: SampledShapes) -> Modes:
    sampled = _model_weights(model, name, Gait(shapes.seconds))
    _, sizes, functions = np.linalg.svd(sampled, full_matrices=False)
    kept = sizes > MIN_SHARE * sizes[0]
    combined = functions[kept].T * (np.sqrt(len(sampled)) / sizes[kept])  # (k, m): weights of mean square 1
    shifts = shapes.means - shown.means.detach().cpu().numpy()
    unturned = torch.nn.functional.normalize(shown.quats, dim=-1).detach().cpu().numpy()
    before = Rotation.from_quat(np.broadcast_to(unturned, shapes.quats.shape).reshape(-1, 4), scalar_first=True)
    after = Rotation.from_quat(shapes.quats.reshape(-1, 4), scalar_first=True)
    found = (after * before.inv()).as_quat(scalar_first=True, canonical=True)
    turns = (found[:, 1:] / np.maximum(found[:, :1], MIN_COSINE)).reshape(shifts.shape)
    both = np.concatenate([shifts, turns], axis=2)
    fitted = np.linalg.lstsq(sampled @ combined, both.reshape(len(both), -1), rcond=None)[0]
    of_modes = fitted.reshape(int(kept.sum()), *both.shape[1:])
    return Modes(of_modes[..., :3], of_modes[..., 3:], lambda gait: _model_weights(model, name, gait) @ combined)


def _model_weights(model: SplatModel, track_id: str, gait: Gait) -> Float[np.ndarray, "t k"]:
    walked = [None] * len(gait.seconds) if gait.walked is None else gait.walked.tolist()
    placements = [ActorPlacement(track_id, scale=gait.scale, walked=way, phase=gait.phase) for way in walked]
    of_parts = (part.shape_weights(gait.seconds.tolist(), placements) for part in model.parts)
    return next(found for found in of_parts if found is not None).cpu().numpy()
