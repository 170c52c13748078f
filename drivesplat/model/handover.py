"""What a block of a long drive takes over from the trained model of the block before it.

After the incremental static Gaussians of DrivingGaussian (Zhou et al., CVPR 2024, arXiv 2312.07920): a stretch of road
starts from the Gaussians that the stretch before it has learned, and only places that these do not know start from seed
points.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor, nn

from drivesplat.model.parameters import MIN_VISIBLE, random_subset
from drivesplat.trajectories.motion import Motion

SAME_TIME = 1e-4
"""Seconds between annotations of the same time."""
Rows = nn.ParameterDict | dict[str, Tensor]
"""Parameters of Gaussians, a row each."""
EQUALLY_NEAR = 0.01
"""Metres within which a place is equally near to both paths, which are the same where the blocks overlap."""
SAME_POSE = 0.5
"""Metres within which an object has the same position in both blocks: found objects have names of their own in each."""


@dataclass(frozen=True)
class Handover:
    """From the world of the block before to this one's: `shift` (3,) metres are added to its places, `seconds` to its
    times. `before` (p, 2) and `here` (q, 2) are the places of the vehicle in the recordings of both, in metres of this
    world. `cap_max` is the maximum number of Gaussians of parts that have none of their own."""

    shift: Float[np.ndarray, "3"]
    seconds: float
    before: Float[np.ndarray, "p 2"]
    here: Float[np.ndarray, "q 2"]
    cap_max: int

    @cached_property
    def _paths(self) -> tuple[cKDTree, cKDTree]:
        return cKDTree(self.before), cKDTree(self.here)

    def shifted(self, params: Rows) -> dict[str, Tensor]:
        """Static Gaussians of the block before, moved into this world: those that are visible and that lie at least as
        near to this block's path as to the path before."""
        rows = {name: values.detach() for name, values in params.items()}
        rows["means"] = rows["means"] + torch.from_numpy(self.shift).to(rows["means"])
        places = rows["means"][:, :2].double().numpy()
        from_before, from_here = (tree.query(places, workers=-1)[0] for tree in self._paths)
        chosen = torch.from_numpy(from_here <= from_before + EQUALLY_NEAR) & is_visible(rows)
        return {name: values[chosen] for name, values in rows.items()}


def is_visible(params: Rows) -> Bool[Tensor, " n"]:
    """Whether Gaussians are opaque enough to be kept by densification."""
    return torch.sigmoid(params["opacities"].detach()) > MIN_VISIBLE


def are_alike(own: Rows, other: Rows) -> bool:
    """Whether Gaussians have the same parameters, with rows of the same shape."""
    shapes = ({name: values.shape[1:] for name, values in params.items()} for params in (own, other))
    return next(shapes) == next(shapes)


def joined(seeds: Rows, learned: dict[str, Tensor], spacing: Float[np.ndarray, " n"], limit: int) -> dict[str, Tensor]:
    """The rows of `learned` Gaussians, then those `seeds` that are farther from all of them than their `spacing`
    (metres) from other seeds, so that no place has both; random `limit` of them where there are more."""
    apart = np.full(len(spacing), np.inf)
    if len(learned["means"]):
        apart = cKDTree(learned["means"].numpy()).query(seeds["means"].detach().numpy(), workers=-1)[0]
    free = torch.from_numpy(np.flatnonzero(apart > spacing))
    kept = torch.from_numpy(random_subset(len(learned["means"]) + len(free), limit))
    return {name: torch.cat([values, seeds[name].detach()[free]])[kept] for name, values in learned.items()}


def same_track(before: Motion, here: Motion, handover: Handover) -> list[tuple[int, int]]:
    """The pairs of annotations of a track in the block before and in this one that are the same, in order; none where
    the object was elsewhere at any of these times, so that it is another one."""
    times = before.times + handover.seconds
    places = before.object_to_world[:, :3, 3] + handover.shift
    apart = np.abs(times[:, None] - here.times)
    pairs = [(int(i), int(j)) for i, j in zip(*np.nonzero(apart < SAME_TIME), strict=True)]
    far = (np.linalg.norm(places[i] - here.object_to_world[j, :3, 3]) > SAME_POSE for i, j in pairs)
    return [] if any(far) else pairs
