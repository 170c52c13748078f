"""What the kernels that composite the chunks of a LiDAR scan's lists have in common, in Triton and in CUDA C++."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.kernels.scan_borders import ON_GPU

RAYS = ON_GPU.beams * ON_GPU.firings
"""Rays of a tile."""
MAX_ALPHA, MIN_TRANSMITTANCE = 0.999, 1e-4
"""The limit of alpha, and the transmittance at which a ray ends."""
NOTHING = 1e-6
"""Transmittance at which a chunk is not multiplied on: what is behind it is not drawn."""


class TileRays(NamedTuple):
    """The rays of a scan's tiles: the `numbers` of the tiles in the scan, azimuths and elevations in radians, and the
    ranges (metres) before which alpha is summed, too."""

    numbers: Int[Tensor, "rows columns"]
    azimuths: Float[Tensor, "b a"]
    elevations: Float[Tensor, "b a"]
    until: Float[Tensor, "b a"]

    @property
    def sizes(self) -> tuple[int, int, int]:
        """The numbers of beams, of firings, and of tiles in a row."""
        beams, firings = self.azimuths.shape
        return beams, firings, self.numbers.shape[1]


class RaySums(NamedTuple):
    """Sums over the Gaussians of a ray, or their gradients: of ranges, alpha, alpha before `until`, and values."""

    range_sum: Float[Tensor, "b a"]
    alpha: Float[Tensor, "b a"]
    before: Float[Tensor, "b a"]
    values: Float[Tensor, "b a v"]


class ScanGradients(NamedTuple):
    """The gradients of n projected Gaussians."""

    means2d: Float[Tensor, "n 2"]
    ranges: Float[Tensor, " n"]
    conics: Float[Tensor, "n 3"]
    slopes: Float[Tensor, "n 2"]
    opacities: Float[Tensor, " n"]
    values: Float[Tensor, "n v"]


class ScanChunks(ABC):
    """Chunks of the lists of tiles."""

    @property
    @abstractmethod
    def firsts(self) -> Int[Tensor, " t1"]:
        """The first chunk of each tile, then the number of all."""

    @property
    @abstractmethod
    def count(self) -> int:
        """The number of chunks at most."""

    @abstractmethod
    def write_transmittances(self, rays: TileRays, passes: Float[Tensor, "m 32"]) -> None:
        """Writes the transmittance of each chunk."""

    @abstractmethod
    def write_sums(
        self,
        rays: TileRays,
        passes: Float[Tensor, "m 32"],
        sums: Float[Tensor, "m s 32"],
        middles: Float[Tensor, "m 32"],
    ) -> None:
        """Writes the sums of each chunk, in the order of `RaySums`, and the median range where it lies in the chunk,
        by the transmittance in front of it, `passes`."""

    @abstractmethod
    def add_gradients(
        self,
        rays: TileRays,
        passes: Float[Tensor, "m 32"],
        rests: Float[Tensor, "m 32"],
        given: RaySums,
        gradients: ScanGradients,
    ) -> None:
        """Adds the gradients of the chunks' Gaussians by those of the sums of rays, `given`, and the remaining sums in
        front of each chunk, `rests`."""
