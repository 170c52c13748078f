"""The sides of an asset that no camera saw, made of its other side.

Vehicles and people are nearly symmetric about the plane through their x and z axes. A side that cameras saw, mirrored,
stands where none did; the Gaussians that a training left there, which no image holds in place, go.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from drivesplat.editing.assets.asset import VISIBLE, Asset
from drivesplat.editing.assets.turntable import AssetView, seen_asset
from drivesplat.model.gaussians import Gaussians, no_colors
from drivesplat.model.harmonics import rotation_of_harmonics_by
from drivesplat.scene.object_class import ObjectClass

SPACING, THICKNESS = 0.1, 0.01
"""Metres between the Gaussians of a hull, and their standard deviation across it."""
SILL, WAIST = 0.14, 0.58
"""Heights of the lower edge of a body and of the cabin of a car, as shares of the height of the box."""
CABIN = np.array([[0.12, 0.5, 0.0], [0.42, 0.85, 0.22]])
"""By which shares of half the length and width a car's cabin is shorter at its back, at its front, and narrower: at the
waist, and at the roof."""
VIEW_STEP = np.radians(10.0)
SEEN_ELEVATION, SEEN_DIAGONALS = np.radians(3.0), 4.0
"""The steps of directions from which an asset hides its hull, the elevation of recording cameras above it, and how far
away in diagonals of the box these are taken to be."""
OPAQUE, MARGIN = 0.5, 0.0
"""The opacity from which an asset hides what is so many metres behind its surface (negative: before it)."""
INSIDE = 0.97
"""The size of a hull in that of the box."""
LEVELS = 8
"""Heights at which colours are taken."""


def completed(asset: Asset) -> Asset:
    """The asset with the sides that no camera saw mirrored from those that cameras saw, marked as invented. Sides
    whose mirror image was not seen either stay as they are. An asset of unknown `seen` is unchanged."""
    if not len(asset.seen):
        return asset
    gaussians = asset.gaussians
    facing = facing_azimuths(gaussians.means, asset.size)
    own, opposite = seen_from(facing, asset.seen), seen_from(-facing, asset.seen)
    kept, copied = own | ~opposite, own & ~opposite
    if not bool(copied.any()):
        return asset
    added = mirrored(gaussians[copied])
    return _with_invented(replace(asset, gaussians=gaussians[kept], invented=asset.invented[kept]), added)


def _with_invented(asset: Asset, added: Gaussians) -> Asset:
    joined = {name: torch.cat([own, added.tensors[name]]) for name, own in asset.gaussians.tensors.items()}
    invented = torch.cat([asset.invented, torch.ones(len(added), dtype=torch.bool)])
    return replace(asset, gaussians=Gaussians(**joined), invented=invented)


def facing_azimuths(means: Float[Tensor, "n 3"], size: np.ndarray) -> Float[Tensor, " n"]:
    """The direction, radians to the left of the front, that the surface of a box faces nearest to each place."""
    half = torch.from_numpy(np.asarray(size)).to(means)[:2] / 2.0
    x, y = (means[:, :2] / half).unbind(dim=1)
    return torch.atan2(y, x)


def seen_from(facing: Float[Tensor, " n"], seen: np.ndarray) -> Bool[Tensor, " n"]:
    """Whether surfaces that face these azimuths are seen from any of the azimuths `seen` (s,)."""
    turns = facing[:, None] - torch.from_numpy(seen).to(facing)
    return torch.cos(turns).amax(dim=1) >= np.cos(VISIBLE)


def mirrored(gaussians: Gaussians) -> Gaussians:
    """The Gaussians reflected about the plane y = 0, with their colours and echoes by direction."""
    signs = gaussians.means.new_tensor([1.0, -1.0, 1.0])
    identity, side = gaussians.quats.new_tensor([[1.0, 0.0, 0.0, 0.0]]), gaussians.means.new_tensor([-1.0])
    reflection = rotation_of_harmonics_by(identity, gaussians.sh.shape[1], side)[0]
    sh = reflection @ gaussians.sh
    logits = gaussians.lidar_logits
    if logits is not None:
        logits = torch.cat([logits[:, :1], logits[:, 1:] * signs[:, None]], dim=1)
    quats = gaussians.quats * gaussians.quats.new_tensor([1.0, -1.0, 1.0, -1.0])
    reflected = Gaussians.of(gaussians.means * signs, quats, gaussians.scales, gaussians.opacities, sh)
    return replace(reflected, lidar_logits=logits)


def filled(asset: Asset) -> Asset:
    """The asset with a plain hull on the sides of which neither they nor their mirror image were seen, for vehicles
    that fill their box: flat Gaussians on the outline of a car or of a box, in the colours that were seen at their
    height, marked as invented. What a training left there stays, below the hull: seen sides need it, too."""
    if not len(asset.seen) or not asset.object_class.is_solid:
        return asset
    gaussians = asset.gaussians
    facing = facing_azimuths(gaussians.means, asset.size)
    known = seen_from(facing, asset.seen) | seen_from(-facing, asset.seen)
    hull, sides = hull_of_vehicle(asset.size, asset.object_class is ObjectClass.CAR)
    upwards = sides.isnan()
    unseen = ~(seen_from(sides, asset.seen) | seen_from(-sides, asset.seen) | upwards)
    hull = hull[unseen | (upwards & unseen.any())]
    if not bool(known.any()) or not len(hull):
        return asset
    hull = hull[_hidden(hull.means, asset)]
    added = _painted(hull, gaussians[known], float(asset.size[2]))
    return _with_invented(asset, added)


def _hidden(places: Float[Tensor, "n 3"], asset: Asset) -> Bool[Tensor, " n"]:
    """Whether an asset hides places in its frame from all directions from which it was seen."""
    hidden = torch.ones(len(places), dtype=torch.bool)
    azimuths = np.unique(np.round(asset.seen / VIEW_STEP)) * VIEW_STEP
    cameras = (AssetView(azimuth, SEEN_ELEVATION, SEEN_DIAGONALS) for azimuth in azimuths.tolist())
    for picture, view in seen_asset(asset, cameras):
        depth = picture.surface_depth
        assert depth is not None
        local = places @ view.viewmat[:3, :3].T + view.viewmat[:3, 3]
        pixels = local @ view.K.T
        u, v = (pixels[:, :2] / pixels[:, 2:]).long().unbind(dim=1)
        u, v = u.clamp(0, view.width - 1), v.clamp(0, view.height - 1)
        hidden &= (picture.alpha[v, u] > OPAQUE) & (local[:, 2] > depth[v, u] + MARGIN)
    return hidden


def hull_of_vehicle(size: np.ndarray, is_car: bool) -> tuple[Gaussians, Float[Tensor, " n"]]:
    """Flat black Gaussians on the outline of a vehicle of this size (metres), SPACING apart: of a box, or of a car's
    body with a cabin, above the ground by the height of a sill; and the directions that they face, radians to the left
    of the front, NaN for those that face upwards."""
    length, width, height = INSIDE * size
    places, facing, axes = [], [], []

    def add(x: np.ndarray, y: np.ndarray, z: float, azimuth: float, axis: int) -> None:
        grid = np.stack(np.broadcast_arrays(x, y, z), axis=-1).reshape(-1, 3)
        places.append(grid)
        facing.append(np.full(len(grid), azimuth))
        axes.append(np.full(len(grid), axis))

    def outline(share: float) -> tuple[np.ndarray, np.ndarray]:
        """Places along and across the vehicle at this share of its height."""
        tapered = (share - WAIST) / (1.0 - WAIST) if is_car and share > WAIST else None
        back, front, narrow = (0.0, 0.0, 0.0) if tapered is None else CABIN[0] + tapered * (CABIN[1] - CABIN[0])
        half = width / 2.0 * (1.0 - narrow)
        ends = -length / 2.0 * (1.0 - back), length / 2.0 * (1.0 - front)
        counts = (max(2, round(np.ptp(edge) / SPACING)) for edge in (ends, (-half, half)))
        return tuple(np.linspace(*edge, count) for edge, count in zip((ends, (-half, half)), counts, strict=True))

    levels = np.arange(SILL, 1.0, SPACING / height)
    for share in levels:
        (along, across), z = outline(share), height * (share - 0.5)
        for end, azimuth in ((0, -np.pi / 2.0), (-1, np.pi / 2.0)):
            add(along, across[end : end + 1 or None], z, azimuth, 1)
        for end, azimuth in ((0, np.pi), (-1, 0.0)):
            add(along[end : end + 1 or None], across, z, azimuth, 0)
    for share in {float(levels[-1]), *((float(levels[levels <= WAIST][-1]),) if is_car else ())}:
        along, across = outline(share)
        add(along[:, None], across[None, :], height * (share - 0.5), np.nan, 2)
    means = torch.from_numpy(np.concatenate(places)).float()
    scales = torch.full_like(means, 0.6 * SPACING)
    scales[torch.arange(len(means)), torch.from_numpy(np.concatenate(axes))] = THICKNESS
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(means), 1)
    hull = Gaussians(means, quats, scales, torch.full((len(means),), 0.95), *no_colors(means))
    return hull, torch.from_numpy(np.concatenate(facing)).float()


def _painted(hull: Gaussians, seen: Gaussians, height: float) -> Gaussians:
    """Gaussians of a hull in the colours, and with the echoes, of those that were `seen` at their heights (medians)."""
    visible = seen[seen.opacities > 0.3] if bool((seen.opacities > 0.3).any()) else seen
    edges = torch.linspace(-height / 2, height / 2, LEVELS + 1)
    level_of = torch.bucketize(hull.means[:, 2].contiguous(), edges[1:-1])
    own = torch.bucketize(visible.means[:, 2].contiguous(), edges[1:-1])
    shape = (len(hull), *visible.shN.shape[1:])
    sh0, logits = torch.zeros(len(hull), 1, 3), None
    if visible.lidar_logits is not None:
        logits = torch.zeros(len(hull), 4, 2)
        logits[:, 0] = visible.lidar_logits[:, 0].median(dim=0).values
    for level in range(LEVELS):
        nearest = (own - level).abs()
        rows = nearest == nearest.min()
        sh0[level_of == level] = visible.sh0[rows].median(dim=0).values
    return replace(hull, sh0=sh0, shN=torch.zeros(shape), lidar_logits=logits)
