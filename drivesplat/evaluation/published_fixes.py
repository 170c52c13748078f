"""Published methods that model moving objects, which vanilla 3DGS shows as ghosts. docs/ghosts.md describes them."""

from typing import NamedTuple


class PublishedFix(NamedTuple):
    """A method and what it adds to a static scene."""

    method: str
    adds: str


PUBLISHED_FIXES = (
    PublishedFix("DrivingGaussian", "a graph of moving objects with Gaussians of their own, seeded by LiDAR"),
    PublishedFix("Street Gaussians", "Gaussians per vehicle that follow its box, refined tracks, colours in time"),
    PublishedFix("EmerNeRF", "neural fields instead of Gaussians: a dynamic field and a flow field, without boxes"),
    PublishedFix("SplatAD", "Gaussians per actor that follow its box, for camera and LiDAR, with rolling shutter"),
)
GHOSTS_DOCUMENT = "docs/ghosts.md"
