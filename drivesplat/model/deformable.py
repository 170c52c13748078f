"""People, animals and cyclists: actors whose limbs move.

A set of Gaussians per track, as `drivesplat.model.actors`, that also deform in the frame of their box, by a lattice
that depends on the phase of a gait and on time: displacements and rotations at its nodes, with trilinear interpolation
between them (Sederberg and Parry, SIGGRAPH 1986, with linear in place of Bernstein bases). The phase advances with the
distance walked, so that limbs stand where the object stands, and follow the pace of an edit.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import normalize

from drivesplat.kernels.constants import constant
from drivesplat.kernels.placement import LocalGaussians, of_owners
from drivesplat.kernels.quaternions import turned
from drivesplat.model.actor_placements import Posed, with_walked
from drivesplat.model.actors import Actors
from drivesplat.model.parameters import make_parameters
from drivesplat.model.part import Shapes
from drivesplat.model.states import ActorPlacement, Want
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.settings.deformable import LatticeSettings
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import DeformableSettings

MIN_STEP, FAR = 0.01, 1e6
"""Metres: the least distance between two annotations where the phase is interpolated, and one that is never walked."""


class Deformation(NamedTuple):
    """What n Gaussians are moved by in the frames of their objects: `shifts` in metres, and `turns`, rotation vectors
    halved (radians): the rotation of a turn t is the normalised quaternion (1, t)."""

    shifts: Float[Tensor, "n 3"]
    turns: Float[Tensor, "n 3"]


@dataclass(frozen=True)
class Undeformed:
    """n Gaussians of a objects: their centres (metres, in the frames of their objects), the object of each as index and
    as one-hot matrix, and half the size (metres) of the objects' boxes, enlarged by the margin."""

    means: Float[Tensor, "n 3"]
    owner: Int[Tensor, " n"]
    owns: Float[Tensor, "n a"]
    reach: Float[Tensor, "a 3"]


@dataclass(frozen=True)
class Lattice:
    """A lattice for each of a objects, whose `nodes` (a, k, x, y, z, 6) hold the displacements (metres) and halved
    rotation vectors (radians) of the nodes for each of k functions of phase and time. The penalty of size rises with
    their `orders` (k,)."""

    settings: LatticeSettings
    orders: Float[np.ndarray, " k"]

    def initial(self, count: int) -> Float[Tensor, "a k x y z 6"]:
        """The nodes of `count` objects, which deform nothing."""
        return torch.zeros(count, len(self.orders), *self.settings.nodes, 6)

    def deformation(
        self, nodes: Float[Tensor, "a k x y z 6"], gaussians: Undeformed, basis: Float[Tensor, "a k"]
    ) -> Deformation:
        """The deformation where the k functions of each object have the values `basis`."""
        around = corners(gaussians, self.settings.nodes)
        at_nodes = torch.einsum("ak,akm->am", basis, nodes.flatten(2)).reshape(-1, 6)
        chosen = at_nodes.index_select(0, around.nodes.flatten())  # its gradient is faster than that of indexing
        values = (around.weights[..., None] * chosen.reshape(-1, 8, 6)).sum(dim=1)
        return Deformation(values[:, :3], values[:, 3:])

    def penalties(self, nodes: Float[Tensor, "a k x y z 6"]) -> dict[str, Float[Tensor, ""]]:
        """Weighted terms of the training loss, by name."""
        own = self.settings
        scaled = (nodes.flatten(2) * constant(tuple(self.orders.tolist()), nodes.device)[:, None]).flatten()
        values = max(1, nodes.numel() // len(self.orders))
        return {
            "lattice_size": own.l2_weight / values * scaled.dot(scaled),
            "lattice_roughness": own.smoothness_weight * roughness(nodes),
        }


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

    def _moved(self, known: Posed, rows: Float[Tensor, "a c"]) -> Posed:
        return super()._moved(known._replace(state=with_walked(known.state, rows, self.cycle_lengths)), rows)

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

    def walked_state(self, time: float, placement: ActorPlacement) -> TimeState:
        """The state of the actors at a time, with the path of a placement of one of them."""
        state = self.state(time, Want(placements=(placement,)))
        assert state.placed is not None
        return with_walked(TimeState(*state.now), state.placed[0], self.cycle_lengths)

    @torch.no_grad()
    def shape_weights(
        self, times: Sequence[float], placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "t k"] | None:
        if not placements or placements[0].source not in self.ids:
            return None
        self.precompute(times)
        states = [self.walked_state(*one) for one in zip(times, placements, strict=True)]
        basis = torch.stack([self.basis(state)[self.ids.index(placements[0].source)] for state in states])
        return torch.cat([torch.ones_like(basis[:, :1]), basis], dim=1)

    def _take_over_track(self, i: int, other: Actors, j: int, common: Sequence[tuple[int, int]]) -> None:
        """As of `Actors`. The gait goes on: what was walked before the first annotation here adds to the phase."""
        super()._take_over_track(i, other, j, common)
        assert isinstance(other, Deformable)
        own, (there, here) = self.timeline.owned[i], common[0]
        walked = other.timeline.tracks[j].motion.walked(other.timeline.tracks[j].motion.times[[there]])
        walked = walked - self.timeline.tracks[i].motion.walked(self.timeline.tracks[i].motion.times[[here]])
        cycles = float(walked[0]) / float(other.cycle_lengths[j])
        self.shared["phase"][own] += cycles - round(cycles)

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


class Corners(NamedTuple):
    """The eight nodes around each of n points: their numbers in the lattices of all objects, and their weights."""

    nodes: Int[Tensor, "n 8"]
    weights: Float[Tensor, "n 8"]


def corners(gaussians: Undeformed, nodes: tuple[int, int, int]) -> Corners:
    """The nodes around the centres of Gaussians. Lattices of `nodes` along x, y and z fill the boxes of the objects;
    centres outside count as on the surface. The weights have a gradient for the centres."""
    device, layer = gaussians.means.device, nodes[1] * nodes[2]
    in_box = (gaussians.means / of_owners(gaussians.reach, gaussians.owns)).clamp(-1.0, 1.0)
    along = (in_box + 1.0) * constant(tuple(0.5 * (count - 1) for count in nodes), device)
    first = along.detach().floor().minimum(constant(tuple(count - 2.0 for count in nodes), device))
    after = along - first
    x, y, z = torch.stack([1.0 - after, after], dim=1).unbind(dim=2)  # (n, 2) each
    weights = (x[:, :, None, None] * y[:, None, :, None] * z[:, None, None, :]).flatten(1)
    lowest = (first * constant((layer, nodes[2], 1), device)).sum(dim=1).long() + gaussians.owner * (nodes[0] * layer)
    around = tuple(i * layer + j * nodes[2] + k for i in (0, 1) for j in (0, 1) for k in (0, 1))
    return Corners(lowest[:, None] + constant(around, device).long(), weights)


def roughness(nodes: Float[Tensor, "a k x y z 6"]) -> Float[Tensor, ""]:
    """The mean squared difference between neighbouring nodes, added over the axes and the k functions."""
    return _Roughness.apply(nodes)


class _Roughness(torch.autograd.Function):
    """A quadratic form, whose gradient is computed with it: a fourth of the tensor operations that autograd takes."""

    @staticmethod
    def forward(ctx: Any, nodes: Tensor) -> Tensor:
        pulls = torch.zeros_like(nodes)
        for axis in (2, 3, 4):
            steps = nodes.diff(dim=axis)
            count, each = steps.shape[axis], nodes.shape[1] / max(1, steps.numel())
            pulls.narrow(axis, 1, count).add_(steps, alpha=each)
            pulls.narrow(axis, 0, count).sub_(steps, alpha=each)
        ctx.save_for_backward(pulls)
        return nodes.flatten().dot(pulls.flatten())

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, above: Tensor) -> Tensor:
        (pulls,) = ctx.saved_tensors
        return 2.0 * above * pulls
