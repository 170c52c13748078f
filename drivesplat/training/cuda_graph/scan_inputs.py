"""The inputs of captured iterations with LiDAR scans: one graph serves all scans of the same shape.

A drive has a hundred scans or more. A training uses each of them some twenty times, and a capture takes as long as
several replays. The graph therefore reads inputs of its own, into which the scan of each iteration is copied.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from drivesplat.kernels import torch_private
from drivesplat.model.states import ModelStates, copied, tensors_of
from drivesplat.training.scans import TrainingScan

Shape = tuple[tuple[torch.Size, torch.dtype], ...]


@dataclass(frozen=True)
class ScanInputs:
    """A scan and the time states that it depends on, whose tensors have the addresses that a graph reads; `number`
    counts the shapes of scans."""

    number: int
    scan: TrainingScan
    states: ModelStates

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors, in a fixed order."""
        return [*self.scan.tensors, *tensors_of(self.states)]


@dataclass
class SharedScanInputs:
    """The inputs of graphs, by shape."""

    _by_shape: dict[Shape, ScanInputs] = field(default_factory=dict)

    def load(self, scan: TrainingScan, states: ModelStates) -> ScanInputs:
        """The inputs of this shape, which hold a scan and its time states from now on."""
        given = [*scan.tensors, *tensors_of(states)]
        shape = _shape_of(given)
        own = self._by_shape.get(shape)
        if own is None:
            own = ScanInputs(len(self._by_shape), copy.deepcopy(scan), copied(states))
            self._by_shape[shape] = own
        else:
            torch_private.copy_all(own.tensors, given)
        return own


def _shape_of(tensors: Sequence[Tensor]) -> Shape:
    return tuple((values.shape, values.dtype) for values in tensors)
