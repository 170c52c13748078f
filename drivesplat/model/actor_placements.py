"""Edited poses of the actors of a model, and the rows of Gaussians that they give."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
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


def with_placements(poses: ObjectPoses, ids: Sequence[str], placements: Sequence[ActorPlacement]) -> ObjectPoses:
    """The poses of the actors `ids` with `placements` applied; an actor without a placement is absent."""
    if not placements:
        return poses._replace(presence=torch.zeros_like(poses.presence))
    edited = [placement.object_to_world for placement in placements]
    matrices = np.stack([np.eye(4) if pose is None else pose for pose in edited])
    turned = Rotation.from_matrix(matrices[:, :3, :3]).as_quat(scalar_first=True)
    scales, is_edited = [placement.scale for placement in placements], [pose is not None for pose in edited]
    numbers = [ids.index(placement.source) for placement in placements]
    values = np.column_stack([turned, matrices[:, :3, 3], scales, is_edited, numbers])
    given = torch.from_numpy(values).to(poses.quats)  # one copy to the device
    rows = given[:, 9].long()
    moved = given[:, 8:9] > 0.0
    return ObjectPoses(
        poses.quats.index_copy(0, rows, torch.where(moved, given[:, :4], poses.quats[rows])),
        poses.translations.index_copy(0, rows, torch.where(moved, given[:, 4:7], poses.translations[rows])),
        poses.sizes.index_copy(0, rows, given[:, 7]),
        torch.zeros_like(poses.presence).index_copy(0, rows, given[:, 8].maximum(poses.presence[rows])),
    )


def with_walked(
    state: TimeState, ids: Sequence[str], placements: Sequence[ActorPlacement], cycles: Float[Tensor, " a"]
) -> TimeState:
    """The time state with the lengths of the paths of placements. A scaled object takes scaled steps; a phase is a path
    of as many `cycles` (metres each)."""
    walked = state.walked.clone()
    for placement in placements:
        i = ids.index(placement.source)
        if placement.walked is not None:
            walked[i] = placement.walked / placement.scale
        if placement.phase:
            walked[i] += placement.phase * cycles[i]
    return state._replace(walked=walked)


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


def placement_sets(
    ids: Sequence[str], owner: Int[Tensor, " n"], placements: Sequence[ActorPlacement]
) -> list[tuple[list[int], slice | Bool[Tensor, " n"]]]:
    """The sets of Gaussians of the actors `ids` that placements give, in order: the indices of the placements of each
    set, and which of the n Gaussians it has. The first has all Gaussians, with the first placement of each actor; each
    further placement of an actor is a set of its Gaussians alone. `owner` is the actor of every Gaussian."""
    own = [i for i, placement in enumerate(placements) if placement.source in ids]
    first = {placements[i].source: i for i in reversed(own)}
    copies = (i for i in own if first[placements[i].source] != i)
    return [
        (sorted(first.values()), slice(None)),
        *(([i], owner == ids.index(placements[i].source)) for i in copies),
    ]
