"""Renderings against the truth that only a synthetic world knows: the street from beside the recorded path, and the
street without the car ahead."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.evaluation.metrics import LpipsMap, RegionMetrics
from drivesplat.images import continuous_intrinsics, read_image
from drivesplat.masks import read_labels
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.removal import removal_of
from drivesplat.model.splat_model import SplatModel, View
from drivesplat.parser import image_size
from drivesplat.regions import LABELS, fill, hull_of, label_image, region_masks
from drivesplat.rigid import inverse
from drivesplat.scene import Frame, Scene
from drivesplat.tracks import Box, box_at
from drivesplat.training.views import view_of
from drivesplat.truth import Truth, TruthFrame, truth_image

LATERAL_REGIONS = ("all", "static")
REMOVAL_REGIONS = ("box", "outside")


@dataclass(frozen=True)
class KnownTruth:
    """The truth of a scene: `path` of its truth.json, the drive it belongs to, and the folder `masks`."""

    truth: Truth
    path: Path
    scene: Scene
    parser: dict[str, Any]
    masks: Path

    def frames(self, camera: str) -> Iterator[tuple[int, Frame, TruthFrame]]:
        """The images of `camera` that have truth, with their numbers in the parser record."""
        by_image = self.truth.by_image()
        for index, frame in enumerate(self.scene.frames):
            if frame.camera == camera and frame.token in by_image:
                yield index, frame, by_image[frame.token]

    def image(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """A true image (h, w, 3) in [0, 1] at `size` (width, height)."""
        return read_image(truth_image(self.path, name), size) / 255.0

    def leading_in(self, index: int, frame: Frame) -> tuple[Box, np.ndarray] | None:
        """The car that `without_leading` lacks in a frame, and the pixels (h, w) bool of its hull; None where it is not
        to be seen."""
        interval, size = self.scene.key_frame_interval, image_size(self.parser, index)
        leading = (track for track in self.scene.tracks if track.id == self.truth.leading)
        box = next((box_at(track, frame.timestamp, interval) for track in leading), None)
        if box is None:
            return None
        hull = hull_of(box, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
        inside = fill(hull, size) if hull is not None else np.zeros(0, dtype=bool)
        return (box, inside) if inside.any() else None


@torch.no_grad()
def rendered(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """What the model shows (h, w, 3) float32, not clamped; with `gaussians` in place of its own where given."""
    return model.render(view, gaussians=gaussians).image.float().cpu().numpy()


def lateral_metrics(
    model: SplatModel, known: KnownTruth, camera: str, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """Per distance to the left, in metres, the metrics over all key frames of `camera` seen from there; None where
    there is no truth."""
    metrics = RegionMetrics(lpips_map, LATERAL_REGIONS)
    frames = list(known.frames(camera))
    for index, frame, truth in frames:
        size = image_size(known.parser, index)
        aside = dataclasses.replace(frame, camera_to_world=_in_world(truth.lateral_camera_to_global, known.scene))
        pose = torch.from_numpy(aside.camera_to_world).float().to(device)
        view = dataclasses.replace(view_of(known.parser, index, device), camera_to_world=pose)
        masks = region_masks(label_image(known.scene, aside, size))
        metrics.add(rendered(model, view), known.image(truth.lateral, size), masks)
    return {str(known.truth.lateral_left_m): metrics.summary()} if frames else None


def removal_metrics(
    model: SplatModel, known: KnownTruth, camera: str, margin: float, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The street with the leading car removed against the street without it, over all key frames of `camera` that see
    the car: the pixels of its box, and the others. None where there is no truth."""
    metrics, measured = RegionMetrics(lpips_map, REMOVAL_REGIONS), False
    for index, frame, truth in known.frames(camera):
        seen = known.leading_in(index, frame) if truth.without_leading else None
        if seen is None:
            continue
        box, inside = seen
        view, size = view_of(known.parser, index, device), image_size(known.parser, index)
        with torch.no_grad():
            gaussians = model.gaussians_at(view.time)
            kept = gaussians[~removal_of(model, gaussians, box, margin).removed]
        own_car = read_labels(known.masks, camera, frame.timestamp, size) == LABELS["own_car"]
        masks = {"box": inside & ~own_car, "outside": ~inside & ~own_car}
        metrics.add(rendered(model, view, kept), known.image(truth.without_leading, size), masks)
        measured = True
    return metrics.summary() if measured else None


def _in_world(camera_to_global: list[list[float]], scene: Scene) -> np.ndarray:
    """A pose of the dataset's global frame in the scene's world frame."""
    camera_to_world = np.array(camera_to_global)
    camera_to_world[:3, 3] -= scene.origin
    return camera_to_world
