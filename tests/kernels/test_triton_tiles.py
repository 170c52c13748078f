"""Tiles' lists of Gaussians, and long lists cut into chunks, compared with torch pixel by pixel.

Without a GPU Triton's kernels run in its interpreter, see conftest.py.
"""

from itertools import pairwise

import numpy as np
import pytest
import torch

pytest.importorskip("triton", reason="Triton is not there for this system")
from helpers.tile_lists import DEVICE, HEIGHT, WIDTH, ellipses, gradients, lists_of_all_lengths, rasterized

from drivesplat.kernels import capacity
from drivesplat.kernels.composited import with_depth_apart
from drivesplat.kernels.triton import chunks
from drivesplat.kernels.triton.joined_chunks import join
from drivesplat.kernels.triton.tiles import Footprints, TileLists, tile_lists

TILE = 16


def covered(gaussians: Footprints, width: int, height: int) -> np.ndarray:
    """Which tiles (c, n, rows, columns) have a pixel that a Gaussian covers by 1/255 or more."""
    x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
    means, conics, _, opacities = (values.cpu().double().numpy() for values in gaussians)
    over_x, over_y = x - means[..., :1], y - means[..., 1:]
    a, b, c = (conics[..., k, None, None] for k in range(3))
    falls = 0.5 * (a * over_x[..., None, :] ** 2 + c * over_y[..., None] ** 2)
    falls = falls + b * over_y[..., None] * over_x[..., None, :]
    seen = opacities[..., None, None] * np.exp(-falls) >= 1 / 255
    full = np.zeros((*seen.shape[:2], -(-height // TILE) * TILE, -(-width // TILE) * TILE), dtype=bool)
    full[..., :height, :width] = seen
    return full.reshape(*seen.shape[:2], full.shape[2] // TILE, TILE, full.shape[3] // TILE, TILE).any(axis=(3, 5))


def by_tile(lists: TileLists) -> list[list[int]]:
    ends = lists.offsets.tolist()
    return [lists.ids[lists.order[start:end]].tolist() for start, end in pairwise(ends)]


@pytest.mark.parametrize("cameras", [1, 2])
def test_tiles_list_the_gaussians_that_reach_them_front_to_back_and_few_others(cameras):
    width, height, count = 75, 40, 300
    gaussians, radii, depths = ellipses(cameras, count, width, height)
    radii[0, ::7, 0], radii[0, 1::7, 1] = 0, 0
    lists = tile_lists(gaussians, radii, depths, width, height)
    shown = covered(gaussians, width, height) & (radii > 0).all(dim=-1).cpu().numpy()[..., None, None]
    assert lists.tiles == (cameras, *shown.shape[2:])
    wanted = [
        {camera * count + int(i) for i in np.flatnonzero(shown[camera, :, row, column])}
        for camera, row, column in np.ndindex(*lists.tiles)
    ]
    for listed, missed in zip(by_tile(lists), wanted, strict=True):
        assert missed <= set(listed) and len(set(listed)) == len(listed)
        near = depths.flatten()[listed].tolist()
        assert near == sorted(near)
        assert all((radii.reshape(-1, 2)[i] > 0).all() for i in listed)
    assert 100 * cameras < shown.sum() <= len(lists.ids) <= 1.05 * shown.sum()


def test_a_planned_capacity_that_is_too_small_leaves_out_the_farthest_gaussians(monkeypatch):
    gaussians, radii, depths = ellipses(1, 200, 75, 40)
    with capacity.exact() as needs:
        every = tile_lists(gaussians, radii, depths, 75, 40)
    assert needs == [len(every.ids)]
    monkeypatch.setattr(capacity, "MIN_CAPACITY", 0)
    monkeypatch.setattr(capacity, "MARGIN", 1.0)
    with capacity.planned([150, 10_000]) as lists_made:
        some, ample = (tile_lists(gaussians, radii, depths, 75, 40) for _ in range(2))
    assert [(int(needed), room) for needed, room in lists_made] == [(len(every.ids), 150), (len(every.ids), 10_000)]
    assert by_tile(ample) == by_tile(every)
    kept = [i for listed in by_tile(some) for i in listed]
    assert len(kept) == 150
    assert all(listed == whole[: len(listed)] for listed, whole in zip(by_tile(some), by_tile(every), strict=True))
    left_out = {i for listed in by_tile(every) for i in listed} - set(kept)
    assert left_out and depths[0, list(left_out)].min() >= depths[0, kept].max()


def test_a_gaussian_whose_conic_has_no_determinant_after_rounding_is_listed_within_its_box():
    """The box is that of gsplat's radii."""
    wide, thin = 4000.0, 0.5
    turn = np.array([[1.0, -1.0], [1.0, 1.0]]) / np.sqrt(2.0)
    conic = turn @ np.diag([1 / wide**2, 1 / thin**2]) @ turn.T
    rounded = torch.tensor([[[conic[0, 0], conic[0, 1], conic[1, 1]]]], dtype=torch.float32, device=DEVICE)
    rounded[..., 1] = -rounded[..., 0]
    means = torch.tensor([[[40.0, 40.0]]], device=DEVICE)
    gaussian = Footprints(means, rounded, torch.ones(1, 1, 3, device=DEVICE), torch.ones(1, 1, device=DEVICE))
    depths, radii = torch.ones(1, 1, device=DEVICE), torch.full((1, 1, 2), 20, dtype=torch.int32, device=DEVICE)
    lists = tile_lists(gaussian, radii, depths, 160, 160)
    listed = [(tile // 10, tile % 10) for tile, found in enumerate(by_tile(lists)) if found]
    assert {(1, 1), (2, 2), (3, 3)} <= set(listed)
    assert all(1 <= row <= 3 and 1 <= column <= 3 for row, column in listed)


def test_gaussians_out_of_view_and_empty_sets_are_not_listed():
    gaussians, _, depths = ellipses(1, 9, 20, 10)
    unseen = tile_lists(gaussians, torch.zeros(1, 9, 2, dtype=torch.int32, device=DEVICE), depths, 20, 10)
    empty = Footprints(*(values[:, :0] for values in gaussians))
    none = tile_lists(empty, torch.zeros(1, 0, 2, dtype=torch.int32, device=DEVICE), depths[:, :0], 20, 10)
    for lists in (unseen, none):
        assert len(lists.ids) == 0 and lists.offsets.tolist() == [0, 0, 0]


@pytest.mark.parametrize(("cameras", "channels"), [(1, 3), (2, 1)])
def test_composited_chunks_equal_whole_lists(cameras, channels, monkeypatch):
    """For tiles with no entries, less than a chunk, a full chunk, and several chunks; for images whose size is no
    multiple of the tile's."""
    monkeypatch.setattr(chunks, "LENGTH", 4)
    given, lists, expected = lists_of_all_lengths(cameras, channels)
    found = chunks.composite(Footprints(*given), lists, WIDTH, HEIGHT, rasterized)[:2]
    for mine, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-5)
    assert float(found[1].detach().max()) > 0.5 and float(found[1].detach()[:, :16, :16].max()) == 0.0
    for theirs, mine in zip(*gradients(given, expected, found), strict=True):
        assert theirs.any()
        torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("channels", [4, 1])
def test_the_last_value_is_depth_where_it_is_wanted(channels, monkeypatch):
    """Images of values, mean depth, and their gradients, also where a pixel shows nothing."""
    monkeypatch.setattr(chunks, "LENGTH", 4)
    given, lists, whole = lists_of_all_lengths(1, channels)
    expected = with_depth_apart(*whole)
    found = chunks.composite(Footprints(*given), lists, WIDTH, HEIGHT, rasterized, with_depth=True)
    assert found.image.shape == (1, HEIGHT, WIDTH, channels - 1) and not found.depth[:, :16, :16].any()
    three = [(images.image, images.alpha, images.depth) for images in (expected, found)]
    for theirs, mine in zip(*three, strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-5, rtol=1e-4)
    for theirs, mine in zip(*gradients(given, *three), strict=True):
        assert theirs.any()
        torch.testing.assert_close(mine, theirs, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("cameras", [1, 2])
def test_the_alpha_of_objects_and_its_gradient_equal_those_of_torch(cameras):
    """For tiles with no entries, one chunk, and several chunks, some of which let nothing through, end their ray or lie
    behind its end."""
    _, lists, _ = lists_of_all_lengths(cameras, 1)
    made, generator = chunks.Chunks.of(lists, 4), torch.Generator().manual_seed(0)
    alpha, past = torch.rand(2, made.count, 256, generator=generator).to(DEVICE)
    past[::3, :100] = 0.0
    alpha[::2, 50:150] *= -1.0
    alpha[1::2, 200:] = 1.0
    past.requires_grad_()
    firsts = made.firsts.tolist()
    seen = join(alpha[..., None], alpha, made.firsts, lists.tiles, WIDTH, HEIGHT, False, past)
    tiles, behind = [], 0
    for start, end in pairwise(firsts):
        passes = torch.cat([torch.ones(1, 256, device=DEVICE), (1.0 - alpha[start:end].abs()).cumprod(dim=0)])[:-1]
        ended = torch.cat([torch.zeros(1, 256, device=DEVICE), (alpha[start:end] < 0.0).cumsum(dim=0)])[:-1]
        counts = (passes > 1e-4) & (ended == 0)
        behind += int((~counts).sum())
        tiles.append(1.0 - torch.where(counts, past[start:end], 1.0).prod(dim=0))
    down, across = lists.tiles[1:]
    whole = torch.stack(tiles).reshape(cameras, down, across, 16, 16).transpose(2, 3).flatten(3, 4).flatten(1, 2)
    expected = whole[:, :HEIGHT, :WIDTH, None]
    torch.testing.assert_close(seen.objects_alpha, expected)
    weights = torch.rand(expected.shape, generator=torch.Generator().manual_seed(1)).to(DEVICE)
    mine, theirs = (torch.autograd.grad((weights * own).sum(), past)[0] for own in (seen.objects_alpha, expected))
    torch.testing.assert_close(mine[: firsts[-1]], theirs[: firsts[-1]])
    assert theirs.any() and behind > 100


@pytest.mark.parametrize("length", [1, 3, 100])
def test_every_chunk_has_the_tile_whose_entries_it_has(length):
    _, lists, _ = lists_of_all_lengths(2, 1)
    found = chunks.Chunks.of(lists, length)
    entries = lists.offsets.diff().tolist()
    tiles = [tile for tile, count in enumerate(entries) for _ in range(-(-count // length))]
    assert found.tile_of[: len(tiles)].tolist() == tiles and len(tiles) <= found.count == len(found.tile_of)
    assert found.firsts.tolist() == [sum(tile < t for tile in tiles) for t in range(len(entries) + 1)]


def test_empty_lists_give_an_empty_image():
    nothing = torch.zeros(0, dtype=torch.int32, device=DEVICE)
    lists = TileLists(nothing, nothing.long(), torch.zeros(3, dtype=torch.int32, device=DEVICE), (1, 1, 2))
    seen = Footprints(*(torch.zeros(1, 5, *tail, device=DEVICE) for tail in ((2,), (3,), (3,), ())))
    image, alpha = chunks.composite(seen, lists, 20, 10, rasterized)[:2]
    assert image.shape == (1, 10, 20, 3) and alpha.shape == (1, 10, 20, 1) and not image.any() and not alpha.any()
