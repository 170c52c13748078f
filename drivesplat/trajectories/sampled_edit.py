"""An edited drive as programs play it: which objects there are, where, and the camera's path, as dense samples.

An object of an edited drive is an instance of the Gaussians of a track; copies are further instances of the same.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class InstanceMotion:
    """Poses `object_to_world` (n, 4, 4) at `seconds` (n,) since the first image, and the distance `walked` (n,) in
    metres by which limbs have advanced. The object is present only during `spans`, each from its first to its last
    second."""

    seconds: np.ndarray
    object_to_world: np.ndarray
    walked: np.ndarray
    spans: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Instance:
    """An object of an edited drive with the Gaussians of the track `source`, scaled by `scale` about the centre of its
    box, which then has `size` (3,) metres, with RGB colours mapped by `color_matrix` (3, 3; None: as trained), and with
    a gait that is ahead by `phase` cycles. It moves by `motion`; None: it is as recorded."""

    id: str
    source: str
    category: str
    size: np.ndarray
    scale: float
    motion: InstanceMotion | None
    color_matrix: np.ndarray | None = None
    phase: float = 0.0


@dataclass(frozen=True)
class CameraMotion:
    """A camera with poses `camera_to_world` (n, 4, 4) at `seconds` (n,) since the first image."""

    seconds: np.ndarray
    camera_to_world: np.ndarray


@dataclass(frozen=True)
class SampledEdit:
    """An edit: its objects that can move, and its camera; None: as recorded."""

    name: str
    instances: tuple[Instance, ...]
    camera: CameraMotion | None
