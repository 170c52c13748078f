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


def with_placements(
    poses: Sequence[ObjectPoses], ids: Sequence[str], placements: Sequence[Sequence[ActorPlacement]]
) -> list[ObjectPoses]:
    """The poses of the actors `ids` at each of several times with the placements of that time applied; an actor without
    one is absent. All of them are copied to the device at once."""
    rows = {id: i for i, id in enumerate(ids)}
    matrices = np.tile(np.eye(4), (len(poses), len(ids), 1, 1))
    rest = np.tile([1.0, 0.0, 0.0], (len(poses), len(ids), 1))  # the scale, whether it is moved, whether it is there
    for own, values, there in zip(matrices, rest, placements, strict=True):
        for placement in there:
            pose = placement.object_to_world
            values[rows[placement.source]] = placement.scale, pose is not None, 1.0
            own[rows[placement.source]] = np.eye(4) if pose is None else pose
    turned = Rotation.from_matrix(matrices[..., :3, :3].reshape(-1, 3, 3)).as_quat(scalar_first=True)
    values = np.concatenate([turned.reshape(*rest.shape[:2], 4), matrices[..., :3, 3], rest], axis=-1)
    given = torch.from_numpy(values).to(poses[0].quats)
    return [
        ObjectPoses(
            torch.where(own[:, 8:9] > 0.0, own[:, :4], known.quats),
            torch.where(own[:, 8:9] > 0.0, own[:, 4:7], known.translations),
            own[:, 7].contiguous(),
            own[:, 9] * own[:, 8].maximum(known.presence),
        )
        for known, own in zip(poses, given, strict=True)
    ]


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
