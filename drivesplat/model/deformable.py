"""People, animals and cyclists: actors whose limbs move.

A set of Gaussians per track, as `drivesplat.model.actors`, that also deform in the frame of their box. The deformation
is that of a lattice in the box, whose nodes move as a Fourier series of the gait's phase and of time. The phase
advances with the distance walked, so that limbs stand where the object stands, and follow the pace of an edit.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels.placement import LocalGaussians
from drivesplat.kernels.quaternions import left_factor
from drivesplat.model.actors import Actors
from drivesplat.model.lattice import corners, deformation, roughness
from drivesplat.model.parameters import make_parameters
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.settings.train import DeformableSettings, GaussianSettings

MIN_STEP, FAR = 0.01, 1e6
"""Metres: the least distance between two annotations where the phase is interpolated, and one that is never walked."""


class Deformable(Actors):
    """The Gaussians of a tracks that deform, as `Actors`.

    `shared` also holds `lattice` (a, k, x, y, z, 6), the displacements (metres) and halved rotation vectors (radians)
    at the nodes of each lattice for k functions: cosine and sine of the phase and its multiples, then the series of the
    colours but its constant; `stride` (a,), the logarithm of a cycle's length relative to the settings'; and `phase`
    (m,), corrections of the phase where the object was at its m annotations, in cycles, linear in the distance walked.
    """

    name = "deformable"

    def __init__(
        self,
        params: dict[str, Tensor],
        tracks: Sequence[ActorTrack],
        settings: DeformableSettings,
        gaussians: GaussianSettings,
    ):
        super().__init__(params, tracks, settings, gaussians)
        self._field = settings
        count, annotations = len(tracks), len(self.shared["yaw"])
        functions = 2 * settings.harmonics + settings.fourier - 1
        added = {
            "lattice": torch.zeros(count, functions, *settings.nodes, 6),
            "stride": torch.zeros(count),
            "phase": torch.zeros(annotations),
        }
        self.shared.update(make_parameters(added))
        walked = [track.motion.walked(track.motion.times) for track in tracks]
        self.register_buffer("_knots", torch.from_numpy(hat_functions(walked)).float(), persistent=False)
        heights = torch.tensor([float(track.size[2]) for track in tracks])
        self.register_buffer("_strides", settings.stride * heights, persistent=False)

    def cycles(self, state: TimeState) -> Float[Tensor, " a"]:
        """The phase of each actor's gait at a time state, in cycles."""
        before, here, after = self._knots  # (m,) each
        x = self._annotated.to(state.walked.dtype).T @ state.walked  # (m,), of the annotation's actor
        hats = torch.minimum((x - before) / (here - before), (after - x) / (after - here)).clamp(0.0, 1.0)
        weights = hats * self._annotated
        corrections = (weights @ self.shared["phase"]) / weights.sum(dim=1).clamp(min=1e-6)
        return state.walked / (self._strides * torch.exp(self.shared["stride"])) + corrections

    def basis(self, state: TimeState) -> Float[Tensor, "a k"]:
        """The k functions of phase and time at a time state."""
        angles = 2.0 * math.pi * self.cycles(state)
        turning = [f(h * angles) for h in range(1, self._field.harmonics + 1) for f in (torch.cos, torch.sin)]
        return torch.cat([torch.stack(turning, dim=1), state.series[:, 1:]], dim=1)

    def local(self, state: TimeState) -> LocalGaussians:
        p = self.params
        around = corners(p["means"], p["owner"], self._owns, self._reach, self._field.nodes)
        moved = deformation(self.shared["lattice"], self.basis(state), around)
        turns = normalize(torch.cat([torch.ones_like(moved.turns[:, :1]), moved.turns], dim=1), dim=1)
        quats = (left_factor(turns) @ p["quats"][..., None])[..., 0]
        return LocalGaussians(p["means"] + moved.shifts, quats, p["scales"], p["opacities"])

    def learning_rates(self) -> dict[str, float]:
        field = self._field
        own = {"lattice": field.lr_lattice, "stride": field.lr_stride, "phase": field.lr_phase}
        return {**super().learning_rates(), **own}

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        field, lattice = self._field, self.shared["lattice"]
        orders = torch.from_numpy(function_orders(field)).to(lattice.dtype)
        size = (orders.to(lattice.device) * lattice.square().mean(dim=(0, 2, 3, 4, 5))).sum()
        own = {
            "lattice_size": field.size_weight * size,
            "lattice_roughness": field.smoothness_weight * roughness(lattice).sum(),
            "gait": field.gait_weight * (self.shared["stride"].square().mean() + self.shared["phase"].square().mean()),
        }
        return {**super().penalties(), **own}


def hat_functions(walked: Sequence[np.ndarray]) -> np.ndarray:
    """The hat functions of linear interpolation between the distances `walked` (metres) at each track's annotations:
    (3, m), the distances before each annotation, at it and after it. The first and last hold beyond the ends."""
    found = []
    for own in walked:
        least = MIN_STEP * np.arange(len(own))
        here = np.maximum.accumulate(own - least) + least
        found.append(np.stack([np.append(-FAR, here[:-1]), here, np.append(here[1:], FAR)]))
    return np.concatenate(found, axis=1)


def function_orders(field: DeformableSettings) -> np.ndarray:
    """The squared order of each function of the lattice: its multiple of the phase, or its place in the series."""
    phases = np.repeat(np.arange(1, field.harmonics + 1), 2)
    return np.concatenate([phases, np.arange(1, field.fourier)]).astype(np.float64) ** 2
