"""Edited poses of the actors of a model, and the rows of Gaussians that they give."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from drivesplat.kernels.placement import ObjectPoses
from drivesplat.model.gaussians import Gaussians, recolored
from drivesplat.model.states import ActorPlacement
from drivesplat.model.timeline import TimeState


class Posed(NamedTuple):
    """Actors at a time: their time state, and the poses at which they are placed."""

    state: TimeState
    poses: ObjectPoses


class Columns(NamedTuple):
    """The columns of a `placement_table`: unit quaternions w, x, y, z, translations in metres and factors of size;
    whether an actor is at this pose, or at its recorded one; whether it is there; whether it has walked `walked` metres
    of its own size, or as recorded; the phase of its gait in cycles; and the index of its placement, -1 without one."""

    quats: Float[Tensor, "a 4"]
    translations: Float[Tensor, "a 3"]
    scales: Float[Tensor, "a 1"]
    is_moved: Float[Tensor, "a 1"]
    is_there: Float[Tensor, "a 1"]
    is_walked: Float[Tensor, "a 1"]
    walked: Float[Tensor, "a 1"]
    phases: Float[Tensor, "a 1"]
    numbers: Float[Tensor, "a 1"]

    @classmethod
    def of(cls, rows: Float[Tensor, "a c"]) -> "Columns":
        """The columns of a table at one time."""
        return cls(*rows.split(COLUMNS, dim=1))


COLUMNS = [4, 3, 1, 1, 1, 1, 1, 1, 1]
"""The widths of `Columns`."""
ABSENT = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
"""The columns after the pose of an actor without a placement."""


def placement_table(
    ids: Sequence[str], placements: Sequence[ActorPlacement], numbers: Sequence[int], times: int, device: torch.device
) -> Float[Tensor, "t a c"]:
    """The placements of the actors `ids`, at most one of each, at their time and then HALF_STEP seconds before and
    after, as rows of numbers: the COLUMNS. `numbers` are their indices in `Want.placements`. One copy to the device."""
    rows = {id: i for i, id in enumerate(ids)}
    matrices, rest = np.tile(np.eye(4), (times, len(ids), 1, 1)), np.tile(ABSENT, (times, len(ids), 1))
    for number, placement in zip(numbers, placements, strict=True):
        row = rows[placement.source]
        for i in range(times):
            own = placement if i == 0 else placement.beside(i - 1)
            walked = None if own.walked is None else own.walked / own.scale
            pose = own.object_to_world
            rest[i, row] = own.scale, pose is not None, True, walked is not None, walked or 0.0, own.phase, number
            matrices[i, row] = np.eye(4) if pose is None else pose
    quats = Rotation.from_matrix(matrices[..., :3, :3].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    table = np.concatenate([quats.reshape(*rest.shape[:2], 4), matrices[..., :3, 3], rest], axis=-1)
    return torch.from_numpy(table.astype(np.float32)).to(device)


def with_placements(poses: ObjectPoses, rows: Float[Tensor, "a c"]) -> ObjectPoses:
    """The poses of actors with the placements of a `placement_table` applied; one without a placement is absent."""
    own = Columns.of(rows)
    moved = own.is_moved > 0.0
    return ObjectPoses(
        torch.where(moved, own.quats, poses.quats),
        torch.where(moved, own.translations, poses.translations),
        own.scales[:, 0].contiguous(),
        own.is_there[:, 0] * own.is_moved[:, 0].maximum(poses.presence),
    )


def with_walked(state: TimeState, rows: Float[Tensor, "a c"], cycles: Float[Tensor, " a"]) -> TimeState:
    """The time state with the lengths of the paths of a `placement_table`. A scaled object takes scaled steps; a phase
    is a path of as many `cycles` (metres each)."""
    own = Columns.of(rows)
    walked = torch.where(own.is_walked > 0.0, own.walked, state.walked[:, None])[:, 0]
    return state._replace(walked=walked + own.phases[:, 0] * cycles)


def with_colors(
    gaussians: Gaussians, ids: Sequence[str], owner: Int[Tensor, " n"], placements: Sequence[ActorPlacement]
) -> Gaussians:
    """The n Gaussians of the actors `ids`, those of placements with a colour matrix in its colours. `owner` is the
    actor of every Gaussian."""
    for placement in placements:
        if placement.color_matrix is not None:
            matrix = torch.from_numpy(placement.color_matrix).to(gaussians.sh0)
            gaussians = recolored(gaussians, matrix, owner == ids.index(placement.source))
    return gaussians


def first_and_copies(ids: Sequence[str], placements: Sequence[ActorPlacement]) -> tuple[list[int], list[int]]:
    """The indices of the first placement of each of the actors `ids`, and those of further ones, each of which is a set
    of its actor's Gaussians alone."""
    own = [i for i, placement in enumerate(placements) if placement.source in ids]
    first = {placements[i].source: i for i in reversed(own)}
    return sorted(first.values()), [i for i in own if first[placements[i].source] != i]
