"""Segmentation networks: what all have in common."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from torch.nn import functional as F

from drivesplat.preprocess.segmentation.label_sets import LabelSet

STRIDE = 32
"""The sides of a network's input are multiples of this number of pixels."""
BATCH = 8
"""Number of images that a GPU segments at a time."""
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True)
class NetworkInput:
    """The images that a network sees: `mean` and `std` of its normalisation, by channel of colours in [0, 1], and its
    size. `size` (width, height) is fixed; where it is None, `height` and the width that the aspect ratio gives, both
    rounded to multiples of STRIDE."""

    mean: tuple[float, ...] = IMAGENET_MEAN
    std: tuple[float, ...] = IMAGENET_STD
    size: tuple[int, int] | None = None
    height: int = 512

    def size_of(self, width: int, height: int) -> tuple[int, int]:
        """Width and height at which a network sees an image of `width` and `height` pixels.

        >>> NetworkInput(height=512).size_of(1600, 900)
        (896, 512)
        """
        if self.size is not None:
            return self.size
        scaled = (self.height * width / height, self.height)
        across, down = (max(1, round(side / STRIDE)) * STRIDE for side in scaled)
        return across, down

    def prepare(self, images: UInt8[np.ndarray, "n h w 3"], device: torch.device) -> Float[Tensor, "n 3 a b"]:
        """Images as a network takes them: resized and normalised."""
        colors = torch.from_numpy(images).to(device).permute(0, 3, 1, 2).float() / 255.0
        across, down = self.size_of(images.shape[2], images.shape[1])
        resized = F.interpolate(colors, (down, across), mode="bilinear", align_corners=False, antialias=True)
        mean, std = (torch.tensor(values, device=device)[:, None, None] for values in (self.mean, self.std))
        return (resized - mean) / std


class Network(ABC):
    """What gives every pixel of an image one of its `labels`. `digest` changes where the labels of an image may."""

    def __init__(self, labels: LabelSet, digest: str, batch: int = 1):
        self.labels, self.digest, self.batch = labels, digest, batch

    @abstractmethod
    def segment(self, images: UInt8[np.ndarray, "n h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "n v u"]:
        """The label of every pixel of at most `batch` images of one size, at `size` (width, height)."""


class ScoreNetwork(Network):
    """A network that takes images as `taken` says, and scores labels on a coarser grid."""

    def __init__(self, labels: LabelSet, taken: NetworkInput, digest: str, device: torch.device):
        super().__init__(labels, digest, BATCH if device.type == "cuda" else 1)
        self.taken, self.device = taken, device

    @abstractmethod
    def scores(self, inputs: Float[Tensor, "n 3 a b"]) -> Float[Tensor, "n c p q"]:
        """The scores of all labels in prepared images; the highest wins."""

    def segment(self, images: UInt8[np.ndarray, "n h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "n v u"]:
        found = []
        with torch.inference_mode():
            for scores in self.scores(self.taken.prepare(images, self.device)).float():
                full = F.interpolate(scores[None], (size[1], size[0]), mode="bilinear", align_corners=False)
                found.append(full[0].argmax(0).to(torch.uint8).cpu().numpy())
        return np.stack(found)
