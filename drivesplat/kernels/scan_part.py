"""The rays of a LiDAR scan that are rendered together, and what follows from them alone."""

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.kernels.scan_borders import ON_CPU, ON_GPU, ScanBorders, TileTable, scan_borders, tile_table
from drivesplat.kernels.scanned_gaussians import FiringTimes, ScannedGaussians, wrapped


@dataclass(frozen=True)
class ScanPart:
    """b beams and a firings: azimuths and elevations in radians, and times in seconds since the timestamp. What
    follows from them is computed once: a view that is rendered again need not repeat it."""

    azimuths: Float[Tensor, "b a"]
    elevations: Float[Tensor, "b a"]
    offsets_s: Float[Tensor, "b a"]

    @cached_property
    def within(self) -> Float[Tensor, "b a"]:
        """The azimuths within ±π."""
        return wrapped(self.azimuths)

    @cached_property
    def firings(self) -> FiringTimes:
        """When each azimuth fires, by the mean azimuth and the median time of each firing."""
        mean = torch.atan2(self.azimuths.sin().sum(dim=0), self.azimuths.cos().sum(dim=0))
        order = mean.argsort()
        return FiringTimes.of(mean[order], self.offsets_s.median(dim=0).values[order])

    @cached_property
    def on_cpu(self) -> "ScanPart":
        """The same on the CPU."""
        return self if self.azimuths.device.type == "cpu" else ScanPart(*(rays.cpu() for rays in self.rays))

    @cached_property
    def borders(self) -> ScanBorders:
        """The borders of tiles for the CPU."""
        return scan_borders(self.within, self.elevations, ON_CPU)

    @cached_property
    def tiles(self) -> TileTable:
        """The table of tiles for the GPU."""
        return tile_table(self.within, self.elevations, ON_GPU)

    @property
    def rays(self) -> tuple[Float[Tensor, "b a"], Float[Tensor, "b a"], Float[Tensor, "b a"]]:
        """Azimuths, elevations and times."""
        return self.azimuths, self.elevations, self.offsets_s

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors that a rendering on their device reads, in a fixed order."""
        tiles = self.borders if self.azimuths.device.type == "cpu" else self.tiles
        return [*self.rays, self.within, *self.firings, *tiles]


class MetPart(NamedTuple):
    """A part of a scan, the Gaussians that its rays meet, and ranges (metres) before which alpha is wanted, too."""

    rays: ScanPart
    gaussians: ScannedGaussians
    until: Float[Tensor, "b a"] | None = None
