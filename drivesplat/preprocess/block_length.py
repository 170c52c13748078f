"""The length of the blocks of a long drive by the memory of a card: `blocks: {length_m: auto}`.

The memory of a training is taken to be that of its images with their masks, of its Gaussians with what is computed from
them, and of the rest, by peaks of `street` on a GPU (docs/measured.md, presets). It is no property of the machine that
cuts the drive: everywhere the blocks are the same.
"""

import logging
from collections.abc import Sequence

import numpy as np

from drivesplat.preprocess.blocks import block_stamps, stretches, without_crowds
from drivesplat.scene.blocks import within
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.splits import training_images
from drivesplat.settings.blocks import AUTO_LENGTHS, BlocksJob, CardSettings

log = logging.getLogger(__name__)

BYTES_PER_PIXEL = 6
"""Of a training image: three of colour, and three masks."""
BASE_GB, GB_PER_MILLION = 1.7, 1.2
"""Memory beside the images: whatever their number, and for each million Gaussians."""


def with_length(scene: Scene, job: BlocksJob) -> tuple[BlocksJob, str]:
    """The job with a length of blocks in metres, and why it was chosen: empty where the settings give it. It is the
    longest of AUTO_LENGTHS, not below the overlap, with which a training of each block fits into `job.card`; the
    shortest where none does. The sentence is also logged as a warning, which the console shows.

    Raises DatasetError for a drive without poses.
    """
    card = job.card
    if card is None:
        return job, ""
    thinned = without_crowds(scene, job.holdout)
    trained = [thinned.frames[i] for i in training_images(thinned, job.holdout)]
    stamps, sizes = block_stamps(trained, thinned), np.array([image_gb(frame, card.width) for frame in trained])
    lengths = [length for length in AUTO_LENGTHS if length >= job.blocks.overlap_m]
    for length in reversed(lengths):
        cut = job.model_copy(update={"blocks": job.blocks.model_copy(update={"length_m": float(length)})})
        inside = [within(stamps, block.used) for block in stretches(scene, cut).blocks]
        images, images_gb = max(((int(own.sum()), float(sizes[own].sum())) for own in inside), key=lambda one: one[1])
        if images_gb + model_gb(card.gaussians) <= card.memory_gb:
            break
    reason = _in_words(length, lengths, images, images_gb, card)
    log.warning("scene %s: blocks of %d m: %s", scene.name, length, reason)
    return cut, reason


def image_gb(frame: Frame, width: int | None) -> float:
    """GPU memory of a training image with its masks, in GB, where it is resized to a width (None: not)."""
    columns = width or frame.width
    return BYTES_PER_PIXEL * columns * round(frame.height * columns / frame.width) * 1e-9


def model_gb(gaussians: int) -> float:
    """GPU memory of a training with so many Gaussians beside its images, in GB."""
    return BASE_GB + GB_PER_MILLION * gaussians * 1e-6


def _in_words(length: int, lengths: Sequence[int], images: int, images_gb: float, card: CardSettings) -> str:
    """Why a length is the one of `lengths` that is chosen, as the end of a sentence."""
    memory, model = f"blocks.memory_gb: {card.memory_gb:g}", model_gb(card.gaussians)
    needs = (
        f"with masks the {images:,} training images of the largest block take {images_gb:.1f} GB of GPU memory, and up "
        f"to {card.gaussians:,} Gaussians {model:.1f} GB"
    )
    if images_gb + model > card.memory_gb:
        return f"{needs}, more than {memory} even in the shortest blocks; set images.width, or lower train.cap_max"
    if length == lengths[-1]:
        return f"{needs}, which fits into {memory}, and no length above is chosen"
    return f"{needs}, and with longer blocks they exceed {memory}"
