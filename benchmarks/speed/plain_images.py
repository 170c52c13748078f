"""The training images as the plain recipe reads them: files that are decoded for every use."""

import warnings
from collections.abc import Iterator
from itertools import chain, repeat
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from drivesplat.io.prefetch import prefetch
from drivesplat.scene.images import read_image, write_png
from drivesplat.scene.training_record import TrainingRecord

MANY_WORKERS = "This DataLoader will create"
"""Torch's warning of more processes than processors; gsplat's example ignores it."""


class ImageFiles(Dataset):
    """The training images of a training record; `paths` are files of their size."""

    def __init__(self, record: TrainingRecord, paths: list[str]):
        self._record = record
        self._images = record.train_images
        self._paths = paths

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, item: int) -> dict[str, Tensor]:
        """`K` (3, 3), `camtoworld` (4, 4), and `image` (h, w, 3), floats from 0 to 255."""
        index = self._images[item]
        with Image.open(self._paths[item]) as image:
            pixels = np.array(image.convert("RGB"))
        return {
            "K": torch.from_numpy(self._record.Ks[index]).float(),
            "camtoworld": torch.from_numpy(self._record.camtoworlds[index]).float(),
            "image": torch.from_numpy(pixels).float(),
        }


def files_of_size(record: TrainingRecord, folder: Path) -> list[str]:
    """Files of the training images at their training size: the recorded files if they have that size, else PNGs in
    `folder`, made once, as the example keeps reduced copies of a scene's images."""

    def file_of(index: int) -> str:
        recorded, size = record.image_paths[index], record.image_size(index)
        with Image.open(recorded) as image:
            if image.size == size:
                return recorded
        reduced = folder / "{}x{}".format(*size) / f"{Path(recorded).stem}.png"
        if not reduced.is_file() or reduced.stat().st_mtime < Path(recorded).stat().st_mtime:
            write_png(reduced, read_image(recorded, size))
        return str(reduced)

    return list(prefetch(file_of, record.train_images))


def loader_of(images: Dataset, workers: int, device: torch.device) -> DataLoader:
    """Single images in random order, decoded by `workers` processes (0: by this one)."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", MANY_WORKERS)
        return DataLoader(
            images,
            batch_size=1,
            shuffle=True,
            num_workers=workers,
            multiprocessing_context="fork" if workers else None,  # the default for users' programs on Linux
            persistent_workers=workers > 0,
            pin_memory=device.type == "cuda",
        )


def endless(loader: DataLoader) -> Iterator[dict[str, Tensor]]:
    """Its images, epoch after epoch. The processes that decode them start with this call."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", MANY_WORKERS)
        return chain(iter(loader), chain.from_iterable(repeat(loader)))
