"""Sums and gradients of the chunks of a LiDAR scan's lists by CUDA C++ kernels.

They differ from Triton's, which give the same scans, in three ways. A warp reads the Gaussians of its chunk where they
are. It skips those that none of its rays meets. All gradients of a Gaussian are summed over the rays together.
"""

import math
from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.cuda.compiled import LENGTH, SCANS, kernels, usable_for
from drivesplat.kernels.cuda.scan_source import WARPS_PER_BLOCK
from drivesplat.kernels.scan_chunks import RAYS, RaySums, ScanChunks, ScanGradients, TileRays
from drivesplat.kernels.scanned_gaussians import ScannedGaussians
from drivesplat.kernels.triton.chunks import Chunks
from drivesplat.kernels.triton.tiles import TileLists

MAX_VALUES = 8
"""Maximum number of values of a Gaussian. Kernels are compiled for each number."""


def can_composite(values: Float[Tensor, "n v"]) -> bool:
    """Whether these kernels can composite Gaussians with such values."""
    return values.shape[1] <= MAX_VALUES and usable_for(values, SCANS)


@dataclass(frozen=True)
class GatheredChunks(ScanChunks):
    """Chunks whose kernels read the Gaussians of entries where they are."""

    gaussians: tuple[Tensor, ...]
    lists: TileLists
    chunks: Chunks

    @classmethod
    def of(
        cls, gaussians: ScannedGaussians, values: Float[Tensor, "n v"], lists: TileLists, length: int = LENGTH
    ) -> "GatheredChunks":
        """Chunks of at most `length` entries."""
        means2d, ranges, conics, slopes, limits, _, opacities = gaussians
        read = means2d, ranges, conics, slopes, limits, opacities, values
        return cls(tuple(tensor.contiguous() for tensor in read), lists, Chunks.of(lists, length))

    @property
    def firsts(self) -> Int[Tensor, " t1"]:
        return self.chunks.firsts

    @property
    def count(self) -> int:
        return self.chunks.count

    def write_transmittances(self, rays: TileRays, passes: Tensor) -> None:
        self._launch("scan_transmittances", rays, passes)

    def write_sums(self, rays: TileRays, passes: Tensor, sums: Tensor, middles: Tensor) -> None:
        self._launch("scan_sums", rays, passes, sums, middles)

    def add_gradients(
        self, rays: TileRays, passes: Tensor, rests: Tensor, given: RaySums, gradients: ScanGradients
    ) -> None:
        self._launch("scan_gradients", rays, passes, rests, *given, *gradients)

    def _launch(self, kernel: str, rays: TileRays, *arguments: Tensor) -> None:
        """Runs a kernel for all chunks, which have to be on the current device."""
        *_, values = self.gaussians
        run = kernels(SCANS, values.shape[1], self.chunks.length, values.device.index)[kernel]
        lists = self.lists.ids, self.lists.order, self.lists.offsets, self.chunks.firsts, self.chunks.tile_of
        sizes = (len(self.firsts) - 1, *rays.sizes)
        blocks = math.ceil(self.count / WARPS_PER_BLOCK)
        run(blocks, RAYS * WARPS_PER_BLOCK, [*self.gaussians, *lists, *rays, *arguments, *sizes])
