"""Gaussians in images, lists of tiles, and gsplat's rasterizer in torch."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from drivesplat.kernels.triton.tiles import Footprints, TileLists

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
WIDTH, HEIGHT, TILE = 39, 20, 16


def ellipses(
    cameras: int, count: int, width: int, height: int, seed: int = 0
) -> tuple[Footprints, torch.Tensor, torch.Tensor]:
    """Gaussians of all sizes and shapes in and around images, their radii and their depths."""
    rng = np.random.default_rng(seed)
    axes = np.exp(rng.uniform(-1.0, 2.5, (cameras, count, 2)))
    turns = Rotation.from_euler("z", rng.uniform(0, np.pi, (cameras * count, 1))).as_matrix()[:, :2, :2]
    turns = turns.reshape(cameras, count, 2, 2)
    conics = turns @ ((1 / axes**2)[..., None] * turns.swapaxes(-1, -2))
    shown = Footprints(
        rng.uniform(-20, [width + 20, height + 20], (cameras, count, 2)),
        conics[..., [0, 0, 1], [0, 1, 1]],
        rng.uniform(0, 1, (cameras, count, 3)),
        rng.uniform(0.0, 1.0, (cameras, count)) ** 3,
    )
    on_device = Footprints(*(torch.from_numpy(values).float().to(DEVICE) for values in shown))
    spread = np.sqrt(np.diagonal(np.linalg.inv(conics), axis1=-2, axis2=-1))
    reach = np.sqrt(2.0 * np.log(np.maximum(255.0 * shown.opacities, 1.0)))
    radii = torch.from_numpy(np.ceil(reach[..., None] * spread)).to(torch.int32).to(DEVICE)
    return on_device, radii, torch.from_numpy(rng.uniform(1, 9, (cameras, count))).float().to(DEVICE)


def rasterized(
    means, conics, values, opacities, width, height, tile, offsets, ids, masks=None, packed=False, least=0.0
):
    """gsplat's `rasterize_to_pixels` in torch, list by list. No ray ends early, and `least` is the smallest alpha."""
    cameras, down, across = offsets.shape
    ends = [*offsets.flatten().tolist()[1:], len(ids)]
    means, conics, opacities = means.reshape(-1, 2), conics.reshape(-1, 3), opacities.flatten()
    values = values.flatten(0, 1) if values.dim() == 3 else values
    image = values.new_zeros(cameras, down * tile, across * tile, values.shape[1] + 1)
    for at, (start, end) in enumerate(zip(offsets.flatten().tolist(), ends, strict=True)):
        if masks is not None and not masks.flatten()[at]:
            image[at // (down * across)] = torch.nan  # gsplat leaves such tiles uninitialized
            continue
        camera, row, column = at // (down * across), at % (down * across) // across, at % across
        x, y = (torch.arange(tile, device=means.device) + 0.5 + tile * first for first in (column, row))
        passes, rows = torch.ones(tile, tile, device=means.device), slice(row * tile, (row + 1) * tile)
        total = torch.zeros(tile, tile, values.shape[1] + 1, device=means.device)
        for i in ids[start:end].tolist():
            over_x, over_y = x[None, :] - means[i, 0], y[:, None] - means[i, 1]
            a, b, c = conics[i]
            falls = 0.5 * (a * over_x**2 + c * over_y**2) + b * over_x * over_y
            alpha = opacities[i] * torch.exp(-falls)
            alpha = torch.where(alpha < least, 0.0, alpha)
            total = total + (passes * alpha)[..., None] * torch.cat([values[i], values.new_ones(1)])
            passes = passes * (1.0 - alpha)
        image[camera, rows, column * tile : (column + 1) * tile] += total
    image = image[:, :height, :width]
    return image[..., :-1], image[..., -1:]


def shuffled(ids: torch.Tensor, offsets: torch.Tensor) -> TileLists:
    """Lists whose entries are stored in another order, followed by undefined entries."""
    order = torch.cat([torch.randperm(len(ids)), torch.full((9,), 10**6)])
    written = torch.empty_like(ids)
    written[order[: len(ids)]] = ids
    room = torch.cat([written, torch.full((9,), 10**6)])
    ends = torch.cat([offsets.flatten(), torch.tensor([len(ids)])])
    made = (room.to(torch.int32), order, ends.to(torch.int32))
    return TileLists(*(values.to(DEVICE) for values in made), tuple(offsets.shape))


Images = tuple[torch.Tensor, torch.Tensor]


def lists_of_all_lengths(
    cameras: int, channels: int, least: float = 0.0
) -> tuple[list[torch.Tensor], TileLists, Images]:
    """Gaussians in images of WIDTH x HEIGHT, lists of up to 13 of them, and the images composited without alpha below
    `least`."""
    torch.manual_seed(0)
    down, across, n = 2, 3, 30
    lengths = [0, 3, 4, 9, 1, 0] if cameras == 1 else [0, 3, 4, 9, 1, 0, 0, 8, 2, 0, 5, 13]
    offsets = torch.tensor([sum(lengths[:i]) for i in range(len(lengths))], dtype=torch.int32).reshape(-1, down, across)
    ids = torch.cat([torch.randperm(n)[:length] + n * (i // (down * across)) for i, length in enumerate(lengths)])
    given = [
        torch.rand(cameras, n, 2) * torch.tensor([WIDTH, HEIGHT]),
        torch.tensor([0.02, 0.005, 0.03]) * (0.5 + torch.rand(cameras, n, 1)),
        torch.rand(cameras, n, channels),
        0.1 + 0.6 * torch.rand(cameras, n),
    ]
    given = [values.to(DEVICE).requires_grad_() for values in given]
    return given, shuffled(ids, offsets), rasterized(*given, WIDTH, HEIGHT, TILE, offsets, ids, least=least)


def gradients(given: list[torch.Tensor], *images: Images) -> list[tuple[torch.Tensor, ...]]:
    """The gradients of the same random weights of each pair of images."""
    generator = torch.Generator().manual_seed(1)
    weights = [torch.randn(image.shape, generator=generator).to(DEVICE) for image in images[0]]
    return [
        torch.autograd.grad(sum((w * image).sum() for w, image in zip(weights, pair, strict=True)), given)
        for pair in images
    ]
