"""Films of long drives: which blocks a frame shows."""

import numpy as np
import pytest

from drivesplat.rendering.block_film import BLEND_M, LEFT_OUT, block_shares
from drivesplat.rendering.captions import DARK, text_picture
from drivesplat.scene.blocks import Block, Blocks
from drivesplat.trajectories.camera_path import CameraPath

SPEED = 2.0
"""Metres between frames, which are a second apart."""


def path(frames: int) -> CameraPath:
    poses = np.repeat(np.eye(4)[None], frames, axis=0)
    poses[:, 0, 3] = SPEED * np.arange(frames)
    return CameraPath(np.arange(frames) * 1_000_000, poses)


def blocks(overlap: int) -> Blocks:
    """Two blocks of 10 s each that overlap by so many seconds."""
    ends = np.array([[0, 10], [10, 20]]) * 1_000_000
    used = [[0, 10 + overlap], [10 - overlap, 20]]
    return Blocks("way", tuple(
        Block(core[None], np.array([own]) * 1_000_000, np.zeros((1, 2))) for core, own in zip(ends, used, strict=True)
    ))  # fmt: skip


def test_one_block_fades_into_the_other_about_their_border():
    shares = block_shares(blocks(overlap=8), path(20))
    assert [share.number for share in shares] == [0] * 10 + [1] * 10
    metres = SPEED * (np.arange(20) - 9.5)
    of_first = [share.weight if share.number == 0 else 1.0 - share.weight for share in shares]
    assert of_first == pytest.approx(np.clip(0.5 - metres / (2 * BLEND_M), 0.0, 1.0))
    assert all(share.other == 1 - share.number for share in shares if share.weight < 1.0)


def test_a_block_that_is_left_out_is_not_blended_with_others():
    shares = block_shares(blocks(overlap=8), path(20), left_out=[1])
    assert [share.number for share in shares] == [0] * 10 + [1] * 10, "time stays true"
    assert all(share.other is None for share in shares)


def test_a_frame_of_a_block_that_is_left_out_says_so():
    dark, said = text_picture("", (96, 54)), text_picture(LEFT_OUT.format(3), (96, 54))
    assert (dark == DARK).all() and said.shape == (54, 96, 3) and said.max() > 200
    assert (said != text_picture(LEFT_OUT.format(4), (96, 54))).any()
    written = np.flatnonzero((said != dark).any(axis=(1, 2)))
    assert written.mean() == pytest.approx(27, abs=2), "in the middle"


def test_a_block_is_not_shown_where_it_has_no_recordings():
    shares = block_shares(blocks(overlap=1), path(20))
    assert [i for i, share in enumerate(shares) if share.other is not None] == [9, 10]
    assert all(share.other is None for share in block_shares(blocks(overlap=0), path(20)))
