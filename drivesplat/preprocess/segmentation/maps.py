"""The stage `segment`: maps of all images of a scene by a network.

- segmented/masks.json: the record
- segmented/{digest of the settings}/semantic/{camera}/{timestamp}.png: a value of `label_sets.CLASSES`, 255 in the sky
  and where the network's label fits none of them
- segmented/{digest of the settings}/sky/…: 255 in the sky
- segmented/{digest of the settings}/vehicles/…: 255 in vehicles, cycles included
- segmented/{digest of the settings}/regions/…: the labels from boxes, left out where the map contradicts
"""

import logging
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import groupby
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from drivesplat.errors import DatasetError
from drivesplat.io.prefetch import prefetch
from drivesplat.io.storage import Provenance, no_provenance, sha256_text
from drivesplat.preprocess.segmentation.label_sets import CLASSES, PEOPLE, SKY, VEHICLES, class_numbers
from drivesplat.preprocess.segmentation.network import Network
from drivesplat.preprocess.segmentation.onnx_network import OnnxNetwork
from drivesplat.preprocess.segmentation.transformer_network import TransformerNetwork
from drivesplat.preprocess.segmentation.weights import local_folder
from drivesplat.provenance.file_digests import file_digest
from drivesplat.scene.images import read_image, read_mask, target_size, write_png
from drivesplat.scene.masks import UNLABELLED, mask_name
from drivesplat.scene.regions import LABELS, label_image
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.segment import SegmentJob, local_path

log = logging.getLogger(__name__)

CACHE = ".segmented"
"""The folder below that of all results with the labels of images, by digest."""
MIN_SKY = 0.005
"""Minimum share of sky over all images, that of the heuristic. Below it the network may have overlooked the sky."""
NO_SKY = (
    "scene %s: %s sees no sky, as is usual in a tunnel; where there is some, leave sky out of segment.use, so that the "
    "heuristic looks for it"
)
MOVABLE = class_numbers((*VEHICLES, *PEOPLE))


@dataclass(frozen=True)
class MapsRecord:
    """The content of segmented/masks.json: the model, the digest of its weights and input, the set of its labels, the
    `classes` of maps by value, the number of `images`, how many of them were segmented by an earlier run, the name of
    the folder of the maps, and the mean share of pixels in the sky, in vehicles, and without a class."""

    model: str
    digest: str
    labels: str
    classes: tuple[str, ...]
    images: int
    reused: int
    folder: str
    sky_share: float
    vehicle_share: float
    unlabelled_share: float
    provenance: Provenance = field(default_factory=no_provenance)


def open_network(job: SegmentJob, device: DeviceSettings) -> Network:
    """The network of a job, on a GPU where there is one and `device` allows it.

    Raises DriveSplatError, with what to do, where a package or the weights are missing, or the model is none that
    segments images.
    """
    on_gpu = device.kind != "cpu" and torch.cuda.is_available()
    place = torch.device("cuda" if on_gpu else "cpu")
    path = local_path(job.model)
    if path is not None and path.suffix == ".onnx":
        return OnnxNetwork(path, place, job.labels, job.height)
    folder = local_folder(job.model) if path is None else path
    return TransformerNetwork(job.model, folder, place, job.labels, job.height)


def make_maps(scene: Scene, job: SegmentJob, network: Network, folder: Path, cache: Path) -> MapsRecord:
    """Writes the maps of every image of a scene below `folder`, and returns their record. Labels of images that are in
    the folder `cache` are not computed again. Other maps below `folder`, of former settings, are removed.

    Raises DatasetError naming an image that cannot be read.
    """
    shares, reused = [], 0
    for frame, labels, known in labelled(scene.frames, job, network, cache):
        shares.append(write_maps(scene, frame, network.labels.classes[labels], folder / job.folder))
        reused += known
    for other in folder.iterdir():
        if other.is_dir() and not other.name.startswith(".") and other.name != job.folder:
            shutil.rmtree(other, ignore_errors=True)
    sky, vehicles, unlabelled = np.mean(shares, axis=0).tolist()
    if sky < MIN_SKY:
        log.warning(NO_SKY, scene.name, job.model)
    return MapsRecord(
        job.model, network.digest, network.labels.name, CLASSES, len(scene.frames), reused, job.folder, sky, vehicles,
        unlabelled,
    )  # fmt: skip


def labelled(
    frames: Sequence[Frame], job: SegmentJob, network: Network, cache: Path
) -> Iterator[tuple[Frame, UInt8[np.ndarray, "h w"], bool]]:
    """Each frame with the network's labels (h, w) of its image, and whether they were in the cache. Neighbouring images
    of one size are segmented together."""
    for _, group in groupby(frames, lambda frame: (frame.width, frame.height)):
        alike = list(group)
        for start in range(0, len(alike), network.batch):
            part = alike[start : start + network.batch]
            size = target_size(part[0], job.images)
            paths = [cache / f"{key}.png" for key in prefetch(partial(image_key, job=job, network=network), part)]
            known = [_cached_labels(path, size) for path in paths]
            absent = [index for index, labels in enumerate(known) if labels is None]
            if absent:
                images = np.stack(list(prefetch(read_image, [part[index].image_path for index in absent])))
                for index, labels in zip(absent, network.segment(images, size), strict=True):
                    write_png(paths[index], labels)
                    known[index] = labels
            for index, (frame, labels) in enumerate(zip(part, known, strict=True)):
                assert labels is not None
                yield frame, labels, index not in absent


def image_key(frame: Frame, job: SegmentJob, network: Network) -> str:
    """The name of an image's labels in the cache: a digest of the network, of the image's file and of the size of the
    labels. Raises DatasetError where the file cannot be read."""
    try:
        image = file_digest(frame.image_path)
    except OSError as error:
        raise DatasetError(f"image {frame.image_path} cannot be read ({error.strerror or error})") from error
    return sha256_text(f"{network.digest} {image} {target_size(frame, job.images)}")[:32]


def _cached_labels(path: Path, size: tuple[int, int]) -> np.ndarray | None:
    """The labels (h, w) in a file of the cache; None where there is none, or it is damaged."""
    try:
        return read_mask(path, size) if path.is_file() else None
    except DatasetError:
        return None


def write_maps(
    scene: Scene, frame: Frame, classes: UInt8[np.ndarray, "h w"], folder: Path
) -> tuple[float, float, float]:
    """Writes all maps of an image below `folder`, given its classes. Returns the shares of pixels in the sky, in
    vehicles, and without a class."""
    sky, vehicles = classes == SKY, np.isin(classes, class_numbers(VEHICLES))
    boxes = label_image(scene, frame, (classes.shape[1], classes.shape[0]))
    maps = {
        "semantic": np.where(sky, np.uint8(UNLABELLED), classes),  # the sky has no Gaussians
        "sky": sky.astype(np.uint8) * 255,
        "vehicles": vehicles.astype(np.uint8) * 255,
        "regions": agreed_regions(boxes, classes),
    }
    for kind, pixels in maps.items():
        write_png(folder / mask_name(kind, frame.camera, frame.timestamp), pixels)
    return float(sky.mean()), float(vehicles.mean()), float((classes == UNLABELLED).mean())


def agreed_regions(boxes: UInt8[np.ndarray, "h w"], classes: UInt8[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w"]:
    """The labels of regions from boxes, `left_out` where the class map contradicts: in the box of a vehicle or person,
    but of another class; of such a class, but in no box. Unlabelled pixels contradict nothing."""
    movable = np.isin(classes, MOVABLE)
    of_objects = (boxes > LABELS["other"]) & (boxes < LABELS["own_car"])
    contradicted = (of_objects & ~movable & (classes != UNLABELLED)) | ((boxes == LABELS["static"]) & movable)
    return np.where(contradicted, np.uint8(LABELS["left_out"]), boxes)
