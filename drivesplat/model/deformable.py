"""People, animals and cyclists: actors whose limbs move.

A set of Gaussians per track, as `drivesplat.model.actors`, that also deform in the frame of their box, by a field that
depends on the phase of a gait and on time. The phase advances with the distance walked, so that limbs stand where the
object stands, and follow the pace of an edit.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels.placement import LocalGaussians, of_owners
from drivesplat.kernels.quaternions import turned
from drivesplat.model.actor_placements import with_walked
from drivesplat.model.actors import Actors
from drivesplat.model.deformation import Field, Undeformed
from drivesplat.model.deformation_network import NetworkField
from drivesplat.model.lattice import LatticeField
from drivesplat.model.parameters import make_parameters
from drivesplat.model.part import ActorPlacement, Shapes
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import DeformableSettings

MIN_STEP, FAR = 0.01, 1e6
"""Metres: the least distance between two annotations where the phase is interpolated, and one that is never walked."""


class Deformable(Actors):
    """The Gaussians of a tracks that deform, as `Actors`.

    `shared` also holds the parameters of a `Field`; `stride` (a,), the logarithm of a cycle's length relative to that
    of the settings; and `phase` (m,), corrections of the phase where the object was at its m annotations, in cycles,
    linear in the distance walked.
    """

    name = "deformable"
    _per_annotation = ("translation", "yaw", "phase")

    def __init__(
        self,
        params: dict[str, Tensor],
        tracks: Sequence[ActorTrack],
        settings: DeformableSettings,
        gaussians: GaussianSettings,
    ):
        super().__init__(params, tracks, settings, gaussians)
        self._gait, self._field = settings.gait, field_of(settings)
        self._out_of_box_weight = settings.out_of_box_weight
        self.penalties_depend_on_time = settings.out_of_box_weight > 0
        initial = self._field.initial(len(tracks))
        self._field_names = tuple(initial)
        self._per_track = ("stride", *(name for name in ("lattice", "embedding") if name in initial))
        gait = {"stride": torch.zeros(len(tracks)), "phase": torch.zeros(len(self.shared["yaw"]))}
        self.shared.update(make_parameters({**gait, **initial}))
        walked = [track.motion.walked(track.motion.times) for track in tracks]
        self.register_buffer("_annotated", self.timeline.of_actors, persistent=False)
        self.register_buffer("_knots", torch.from_numpy(hat_functions(walked)).float(), persistent=False)
        strides = [settings.gait.stride_of(track.object_class) * float(track.size[2]) for track in tracks]
        self.register_buffer("_strides", torch.tensor(strides), persistent=False)

    def _state_with(self, state: TimeState, placements: Sequence[ActorPlacement]) -> TimeState:
        return with_walked(state, self._known, placements, self.cycle_lengths)

    @property
    def cycle_lengths(self) -> Float[Tensor, " a"]:
        """The length of a gait cycle of each actor in metres."""
        return self._strides * torch.exp(self.shared["stride"])

    def cycles(self, state: TimeState) -> Float[Tensor, " a"]:
        """The phase of each actor's gait at a time state, in cycles; of a mirrored one half a cycle later, so that its
        steps are those of its other side."""
        before, here, after = self._knots  # (m,) each
        x = state.walked.index_select(0, self._annotated_actor)
        hats = torch.minimum((x - before) / (here - before), (after - x) / (after - here)).clamp(0.0, 1.0)
        weights = hats * self._annotated
        corrections = (weights @ self.shared["phase"]) / weights.sum(dim=1).clamp(min=1e-6)
        return state.walked / self.cycle_lengths + corrections + 0.25 * (1.0 - state.side)

    def basis(self, state: TimeState) -> Float[Tensor, "a k"]:
        """The k functions that deform each actor at a time state: cosine and sine of the phase and of its multiples,
        then the series of the colours without its constant."""
        cycles = self.cycles(state)
        multiples = torch.arange(1, self._gait.harmonics + 1, device=cycles.device)
        angles = 2.0 * math.pi * multiples * cycles[:, None]
        turning = torch.stack([torch.cos(angles), torch.sin(angles)], dim=2).flatten(1)
        return torch.cat([turning, state.series[:, 1:]], dim=1)

    def local(self, state: TimeState) -> LocalGaussians:
        p = self.params
        gaussians = Undeformed(p["means"], p["owner"], self._owns, self._reach)
        moved = self._field.deformation(dict(self.shared.items()), gaussians, self.basis(state))
        quats = turned(p["quats"], moved.turns)
        return LocalGaussians(p["means"] + moved.shifts, quats, p["scales"], p["opacities"])

    @torch.no_grad()
    def shapes(self, track_id: str, times: Sequence[float]) -> Shapes | None:
        rows = self.of_track(track_id)
        if rows is None:
            return None
        self.precompute(times)
        locals_ = [self.local(self.time_state(time)) for time in times]
        quats = normalize(torch.stack([local.quats[rows] for local in locals_]), dim=-1)
        return Shapes(torch.stack([local.means[rows] for local in locals_]), quats)

    @torch.no_grad()
    def shape_weights(
        self, times: Sequence[float], placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "t k"] | None:
        if not placements or placements[0].source not in self._known:
            return None
        self.precompute(times)
        states = [
            self._state_with(self.time_state(time), [placement])
            for time, placement in zip(times, placements, strict=True)
        ]
        basis = torch.stack([self.basis(state)[self._known.index(placements[0].source)] for state in states])
        return torch.cat([torch.ones_like(basis[:, :1]), basis], dim=1)

    @property
    def decaying(self) -> tuple[str, ...]:
        return (*super().decaying, "stride", "phase", *self._field_names)

    def learning_rates(self) -> dict[str, float]:
        own = {"stride": self._gait.lr_stride, "phase": self._gait.lr_phase}
        return {**super().learning_rates(), **own, **dict.fromkeys(self._field_names, self._field.learning_rate)}

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        corrections = self.shared["stride"].square().mean() + self.shared["phase"].square().mean()
        of_field = self._field.penalties(dict(self.shared.items()))
        return {**super().penalties(), "gait": self._gait.weight * corrections, **of_field}

    def penalties_at(self, time: float) -> dict[str, Float[Tensor, ""]]:
        if not self._out_of_box_weight:
            return {}
        state = self.time_state(time)
        present = of_owners(state.present.float(), self._owns)
        outside = (self.local(state).means.abs() - of_owners(self._reach, self._owns)).clamp(min=0.0)
        mean = (outside.sum(dim=1) * present).sum() / present.sum().clamp(min=1.0)
        return {"out_of_box": self._out_of_box_weight * mean}


def field_of(settings: DeformableSettings) -> Field:
    """The field that settings name, for the functions of `Deformable.basis`."""
    orders = np.concatenate([np.repeat(np.arange(1, settings.gait.harmonics + 1), 2), np.arange(1, settings.fourier)])
    if settings.field == "lattice":
        return LatticeField(settings.lattice, orders.astype(np.float64))
    return NetworkField(settings.network, len(orders))


def hat_functions(walked: Sequence[np.ndarray]) -> np.ndarray:
    """The hat functions of linear interpolation between the distances `walked` (metres) at each track's annotations:
    (3, m), the distances before each annotation, at it and after it. The first and last hold beyond the ends."""
    found = []
    for own in walked:
        least = MIN_STEP * np.arange(len(own))
        here = np.maximum.accumulate(own - least) + least
        found.append(np.stack([np.append(-FAR, here[:-1]), here, np.append(here[1:], FAR)]))
    return np.concatenate(found, axis=1)
