"""The inputs of captured steps: one graph serves all images of the same shape, another all LiDAR scans of one shape.

A capture takes as long as ten replays. A graph for each image would be captured again whenever the graphs become
invalid: with 31 images that took a quarter of 3,500 steps. The graph therefore reads inputs of its own, into which the
image or scan of each step is copied.
"""

import copy
from collections.abc import Hashable
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from torch import Tensor

from drivesplat.kernels import torch_private
from drivesplat.model.states import ModelStates, copied, tensors_of
from drivesplat.training.coarse_to_fine import TrainingImages
from drivesplat.training.scans import TrainingScan
from drivesplat.training.views import LidarDepth, TrainingView

MEASURED, MEASURED_OF_CAMERA = 8, 4
"""Steps with images before one is captured: they measure the entries that the lists of any need. Where each camera has
graphs of its own, a camera's share of the first, but no fewer than the second."""


@dataclass(frozen=True)
class ImageInputs:
    """An image with its camera, and the states of the parts, whose tensors have the addresses that a graph reads;
    `number` counts the shapes of images."""

    number: int
    image: TrainingView
    states: ModelStates

    @property
    def view(self) -> TrainingView:
        """The image. Its camera has no cached values, which would be those of an earlier image."""
        return replace(self.image, view=replace(self.image.view))


@dataclass
class SharedImageInputs:
    """The inputs of graphs, by shape, for the `images` of a training; of each camera its own where a step depends on
    the camera's name (`by_camera`)."""

    images: TrainingImages
    by_camera: bool
    _by_shape: dict[Hashable, ImageInputs] = field(default_factory=dict)

    @cached_property
    def measured(self) -> int:
        """The number of steps before one is captured."""
        cameras = len({image.view.camera for image in self.images.views}) if self.by_camera else 1
        return max(1, min(max(MEASURED // cameras, MEASURED_OF_CAMERA), len(self.images.views) // cameras))

    def load(self, image: TrainingView, states: ModelStates) -> ImageInputs:
        """The inputs of this shape, which hold an image and its states from now on."""
        given = _tensors(image, states)
        camera = image.view.camera if self.by_camera else None
        shape = (camera, image.lidar is None, *_masks(image), *((values.shape, values.dtype) for values in given))
        own = self._by_shape.get(shape)
        if own is None:
            own = self._by_shape[shape] = self._copied(image, states)
        torch_private.copy_all(_tensors(own.image, own.states), given)
        if image.lidar is not None and own.image.lidar is not None:
            _load_depths(own.image.lidar, image.lidar)
        return own

    def _copied(self, image: TrainingView, states: ModelStates) -> ImageInputs:
        """New inputs, with the shape of an image and its states."""
        seconds = None if image.view.seconds is None else image.view.seconds.clone()
        K, camera_to_world = image.view.K.clone(), image.view.camera_to_world.clone()
        view = replace(image.view, K=K, camera_to_world=camera_to_world, seconds=seconds)
        copies = {name: mask.clone() for name, mask in _masks(image).items()}
        lidar = None if image.lidar is None else self._room_for(image.lidar)
        own = replace(image, view=view, pixels=image.pixels.clone(), lidar=lidar, **copies)
        return ImageInputs(len(self._by_shape), own, copied(states))

    def _room_for(self, lidar: LidarDepth) -> LidarDepth:
        """Depth of this kind, with room for that of any image."""
        most = max(len(image.lidar.depth) for image in self.images.views if image.lidar is not None)
        pixels, depth = lidar.pixels.new_zeros(most), lidar.depth.new_zeros(most)
        return LidarDepth(pixels, depth, torch.zeros((), dtype=torch.int64, device=depth.device))


def can_share(image: TrainingView) -> bool:
    """Whether a step with an image depends on nothing but its tensors, the parts' states and, with exposures, the name
    of its camera. Otherwise Python looks up what belongs to its time: its graph serves no other."""
    return image.view.shutter is None and image.classes is None


def _tensors(image: TrainingView, states: ModelStates) -> list[Tensor]:
    """All tensors of an image but LiDAR depth, and those of states, in a fixed order."""
    view = image.view
    times = [] if view.seconds is None else [view.seconds]
    return [view.K, view.camera_to_world, *times, image.pixels, *_masks(image).values(), *tensors_of(states)]


def _masks(image: TrainingView) -> dict[str, Tensor]:
    """The masks that an image has, by name."""
    masks = {"sky": image.sky, "not_sky": image.not_sky, "moving": image.moving, "ego_mask": image.ego_mask}
    return {name: mask for name, mask in masks.items() if mask is not None}


def _load_depths(own: LidarDepth, given: LidarDepth) -> None:
    count = len(given.depth)
    own.pixels[:count].copy_(given.pixels)
    own.depth[:count].copy_(given.depth)
    if own.count is not None:
        own.count.fill_(count)


@dataclass(frozen=True)
class ScanInputs:
    """A scan and the states of the parts, whose tensors have the addresses that a graph reads; `number` counts the
    shapes of scans."""

    number: int
    scan: TrainingScan
    states: ModelStates

    @property
    def tensors(self) -> list[Tensor]:
        """All tensors, in a fixed order."""
        return [*self.scan.tensors, *tensors_of(self.states)]


@dataclass
class SharedScanInputs:
    """The inputs of graphs, by shape."""

    _by_shape: dict[Hashable, ScanInputs] = field(default_factory=dict)

    def load(self, scan: TrainingScan, states: ModelStates) -> ScanInputs:
        """The inputs of this shape, which hold a scan and its states from now on."""
        given = [*scan.tensors, *tensors_of(states)]
        shape = tuple((values.shape, values.dtype) for values in given)
        own = self._by_shape.get(shape)
        if own is None:
            own = self._by_shape[shape] = ScanInputs(len(self._by_shape), copy.deepcopy(scan), copied(states))
        else:
            torch_private.copy_all(own.tensors, given)
        return own
