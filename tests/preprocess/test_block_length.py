"""length_m: auto: the longest blocks whose images and Gaussians fit into the memory of a card, the same on all
machines."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from helpers.long_paths import drive_along, straight
from pydantic import ValidationError

from drivesplat.preprocess.block_length import image_gb, model_gb, with_length
from drivesplat.preprocess.blocks import block_scene, cut_into_blocks
from drivesplat.scene.scene import Scene
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.blocks import AUTO_LENGTHS, BlockSettings, BlocksJob, CardSettings, CutSettings
from drivesplat.settings.images import HoldoutSettings

HOLDOUT = HoldoutSettings()
SIZE = (1600, 900)
GB = 6 * SIZE[0] * SIZE[1] * 1e-9
"""Of an image with its masks."""


def large(scene: Scene) -> Scene:
    """The scene with images of `SIZE`."""
    return replace(scene, frames=tuple(replace(frame, width=SIZE[0], height=SIZE[1]) for frame in scene.frames))


def job(memory_gb: float, overlap_m: float = 40.0, gaussians: int = 1_000_000, width: int | None = None) -> BlocksJob:
    card = CardSettings(memory_gb=memory_gb, gaussians=gaussians, width=width)
    return BlocksJob(blocks=CutSettings(length_m="auto", overlap_m=overlap_m), holdout=HOLDOUT, card=card)


def memory_for(images: int, gaussians: int = 1_000_000) -> float:
    return model_gb(gaussians) + images * GB


def largest(scene: Scene, cut: BlocksJob, length_m: float) -> int:
    """The training images of the block of a length that has the most, by the scenes of blocks."""
    own = cut.model_copy(update={"blocks": cut.blocks.model_copy(update={"length_m": length_m})})
    blocks = cut_into_blocks(scene, own)
    scenes = [block_scene(scene, blocks, number, HOLDOUT) for number in range(len(blocks.blocks))]
    return max(frame_groups(one, HOLDOUT).count("train") for one in scenes)


@pytest.mark.parametrize(
    ("cameras", "millions", "measured_gb"), [(1, 0.5, 2.0), (1, 1.5, 3.0), (6, 1.5, 4.4), (6, 3.0, 6.3)]
)
def test_the_model_of_memory_is_at_least_what_presets_were_measured_with(cameras, millions, measured_gb):
    """Peaks of `street` in docs/measured.md, with a CUDA context of half a gigabyte; 35 of 40 key frames are trained
    on."""
    taken = model_gb(round(millions * 1e6)) + cameras * 35 * GB
    assert measured_gb + 0.5 <= taken < 1.25 * (measured_gb + 0.5)


@pytest.mark.parametrize("images", [150, 220, 300])
def test_the_length_is_the_longest_with_which_the_images_of_every_block_fit(images):
    scene = large(drive_along(straight(1500)))
    cut, reason = with_length(scene, job(memory_for(images)))
    length = cut.blocks.length_m
    assert length in AUTO_LENGTHS and 40 < length < 400
    slack = 4
    """Images near a border that count in one block more or less."""
    assert largest(scene, cut, length) <= images + slack
    assert largest(scene, cut, length + 20.0) > images - slack
    assert "and with longer blocks they exceed blocks.memory_gb" in reason
    assert f"{memory_for(images):g}" in reason and "up to 1,000,000 Gaussians 2.9 GB" in reason


def test_blocks_are_not_longer_or_shorter_than_the_bounds_and_the_sentence_says_so():
    scene = large(drive_along(straight(900)))
    cut, reason = with_length(scene, job(1000.0))
    assert cut.blocks.length_m == 400 and "fits into blocks.memory_gb: 1000, and no length above is chosen" in reason
    cut, reason = with_length(scene, job(1.0))
    assert cut.blocks.length_m == 40
    assert (
        "more than blocks.memory_gb: 1 even in the shortest blocks; set images.width, or lower train.cap_max" in reason
    )
    cut, _ = with_length(scene, job(1.0, overlap_m=90.0))
    assert cut.blocks.length_m == 100, "not below the overlap"


def test_smaller_images_more_memory_and_fewer_gaussians_make_longer_blocks():
    scene = large(drive_along(straight(1500)))
    lengths = [
        with_length(scene, one)[0].blocks.length_m
        for one in (
            job(memory_for(200)),
            job(memory_for(260)),
            job(memory_for(200), gaussians=800_000),
            job(memory_for(200), width=1300),
        )
    ]
    assert lengths[0] < min(lengths[1:])
    assert image_gb(scene.frames[0], 800) == pytest.approx(GB / 4) and image_gb(scene.frames[0], None) == GB


def test_slow_streets_shorten_blocks_and_standing_does_not():
    fast = straight(1000)
    slow = np.concatenate([straight(400), straight(600, speed=3.0, start=400.0), straight(1000, start=600.0)])
    standing = np.concatenate([straight(400), np.full((3000, 2), [400.0, 0.0]), straight(1000, start=400.0)])
    of = [with_length(large(drive_along(places)), job(memory_for(280)))[0] for places in (fast, slow, standing)]
    lengths = [cut.blocks.length_m for cut in of]
    assert lengths[1] < 0.6 * lengths[0] and abs(lengths[2] - lengths[0]) <= 20, lengths


def test_a_length_in_metres_is_kept_and_a_chosen_one_is_said(caplog):
    scene = large(drive_along(straight(900)))
    given = BlocksJob(blocks=CutSettings(length_m=77.0), holdout=HOLDOUT)
    assert with_length(scene, given) == (given, "") and not caplog.records
    with caplog.at_level(logging.WARNING):
        cut, reason = with_length(scene, job(memory_for(200)))
    (said,) = caplog.messages
    assert said == f"scene long: blocks of {cut.blocks.length_m:g} m: {reason}"
    assert cut_into_blocks(scene, cut).length_m == cut.blocks.length_m


def test_settings_take_auto_and_refuse_other_words_and_overlaps_that_are_too_long():
    assert BlockSettings(length_m="auto", overlap_m=400.0).memory_gb == 8.0
    with pytest.raises(ValidationError, match=r"overlap_m must be at most length_m \(400\)"):
        BlockSettings(length_m="auto", overlap_m=401.0)
    with pytest.raises(ValidationError, match="length_m"):
        BlockSettings(length_m="long")
    with pytest.raises(ValidationError, match="length_m"):
        BlockSettings(length_m=10.0)
