"""People, animals and cyclists: actors whose limbs move.

A set of Gaussians per track, as `drivesplat.model.actors`, that also deform in the frame of their box, by a lattice
that depends on the phase of a gait and on time. The phase advances with the distance walked, so that limbs stand where
the object stands, and follow the pace of an edit.
"""

import math
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from drivesplat.kernels.placement import LocalGaussians
from drivesplat.kernels.quaternions import turned
from drivesplat.model.actor_placements import Posed, with_walked
from drivesplat.model.actors import Actors
from drivesplat.model.lattice import Lattice, Undeformed
from drivesplat.model.parameters import make_parameters
from drivesplat.model.part import Shapes
from drivesplat.model.states import ActorPlacement
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import DeformableSettings

MIN_STEP, FAR = 0.01, 1e6
"""Metres: the least distance between two annotations where the phase is interpolated, and one that is never walked."""


class Deformable(Actors):
    """The Gaussians of a tracks that deform, as `Actors`.

    `shared` also holds the nodes of their lattices, `lattice` (see `Lattice`); `stride` (a,), the logarithm of a
    cycle's length relative to the settings; and `phase` (m,), corrections of the phase where the object was at its m
    annotations, in cycles, linear in the distance walked.
    """

    name = "deformable"
    decaying = (*Actors.decaying, "stride", "phase", "lattice")
    _per_annotation = ("translation", "yaw", "phase")
    _per_track = ("stride", "lattice")

    def __init__(
        self,
        params: dict[str, Tensor],
        tracks: Sequence[ActorTrack],
        settings: DeformableSettings,
        gaussians: GaussianSettings,
    ):
        super().__init__(params, tracks, settings, gaussians)
        self._gait, self._lattice = settings.gait, lattice_of(settings)
        gait = {"stride": torch.zeros(len(tracks)), "phase": torch.zeros(len(self.shared["yaw"]))}
        self.shared.update(make_parameters({**gait, "lattice": self._lattice.initial(len(tracks))}))
        walked = [track.motion.walked(track.motion.times) for track in tracks]
        self.register_buffer("_annotated", self.timeline.of_actors, persistent=False)
        self.register_buffer("_knots", torch.from_numpy(hat_functions(walked)).float(), persistent=False)
        strides = [settings.gait.stride_of(track.object_class) * float(track.size[2]) for track in tracks]
        self.register_buffer("_strides", torch.tensor(strides), persistent=False)

    def _moved(self, known: Posed, placements: Sequence[ActorPlacement]) -> Posed:
        walked = with_walked(known.state, self.ids, placements, self.cycle_lengths)
        return super()._moved(known._replace(state=walked), placements)

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
        moved = self._lattice.deformation(self.shared["lattice"], gaussians, self.basis(state))
        quats = turned(p["quats"], moved.turns)
        return LocalGaussians(p["means"] + moved.shifts, quats, p["scales"], p["opacities"])

    @torch.no_grad()
    def shapes(self, track_id: str, times: Sequence[float]) -> Shapes | None:
        rows = self.of_track(track_id)
        if rows is None:
            return None
        self.precompute(times)
        locals_ = [self.local(TimeState(*self.state(time).now)) for time in times]
        quats = normalize(torch.stack([local.quats[rows] for local in locals_]), dim=-1)
        return Shapes(torch.stack([local.means[rows] for local in locals_]), quats)

    @torch.no_grad()
    def shape_weights(
        self, times: Sequence[float], placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "t k"] | None:
        if not placements or placements[0].source not in self.ids:
            return None
        self.precompute(times)
        states = [
            with_walked(TimeState(*self.state(time).now), self.ids, [placement], self.cycle_lengths)
            for time, placement in zip(times, placements, strict=True)
        ]
        basis = torch.stack([self.basis(state)[self.ids.index(placements[0].source)] for state in states])
        return torch.cat([torch.ones_like(basis[:, :1]), basis], dim=1)

    def learning_rates(self) -> dict[str, float]:
        own = {"stride": self._gait.lr_stride, "phase": self._gait.lr_phase}
        return {**super().learning_rates(), **own, "lattice": self._lattice.settings.learning_rate}

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        corrections = self.shared["stride"].square().mean() + self.shared["phase"].square().mean()
        of_lattice = self._lattice.penalties(self.shared["lattice"])
        return {**super().penalties(), "gait": self._gait.weight * corrections, **of_lattice}


def lattice_of(settings: DeformableSettings) -> Lattice:
    """The lattice of the settings, for the functions of `Deformable.basis`."""
    orders = np.concatenate([np.repeat(np.arange(1, settings.gait.harmonics + 1), 2), np.arange(1, settings.fourier)])
    return Lattice(settings.lattice, orders.astype(np.float64))


def hat_functions(walked: Sequence[np.ndarray]) -> np.ndarray:
    """The hat functions of linear interpolation between the distances `walked` (metres) at each track's annotations:
    (3, m), the distances before each annotation, at it and after it. The first and last hold beyond the ends."""
    found = []
    for own in walked:
        least = MIN_STEP * np.arange(len(own))
        here = np.maximum.accumulate(own - least) + least
        found.append(np.stack([np.append(-FAR, here[:-1]), here, np.append(here[1:], FAR)]))
    return np.concatenate(found, axis=1)
