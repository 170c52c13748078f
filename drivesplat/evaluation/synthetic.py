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
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.removal import removal_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.recording import Recording
from drivesplat.regions import fill, hull_of, label_image, region_masks
from drivesplat.rigid import inverse
from drivesplat.tracks import Box, box_at
from drivesplat.training.views import view_of
from drivesplat.truth import Truth, TruthFrame, truth_image

LATERAL_REGIONS = ("all", "static")
REMOVAL_REGIONS = ("box", "outside")


@dataclass(frozen=True)
class KnownTruth:
    """The truth of a recording; `path` is that of its truth.json."""

    truth: Truth
    path: Path
    recording: Recording

    def frames(self, camera: str) -> Iterator[tuple[int, TruthFrame]]:
        """The images of `camera` that have truth, by their numbers in the recording."""
        by_image = self.truth.by_image()
        for index, frame in enumerate(self.recording.scene.frames):
            if frame.camera == camera and frame.token in by_image:
                yield index, by_image[frame.token]

    def image(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """A true image (h, w, 3) in [0, 1] at `size` (width, height)."""
        return read_image(truth_image(self.path, name), size) / 255.0

    def leading_in(self, index: int) -> tuple[Box, np.ndarray] | None:
        """The car that `without_leading` lacks in an image, and the pixels (h, w) bool of its hull; None where it is
        not to be seen."""
        scene, frame, size = self.recording.scene, self.recording.frame(index), self.recording.size(index)
        leading = scene.track(self.truth.leading) if self.truth.leading else None
        box = box_at(leading, frame.timestamp, scene.key_frame_interval) if leading else None
        if box is None:
            return None
        hull = hull_of(box, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
        inside = fill(hull, size) if hull is not None else np.zeros(0, dtype=bool)
        return (box, inside) if inside.any() else None


@torch.no_grad()
def rendered(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """What the model shows (h, w, 3) float32, not clamped; with `gaussians` in place of its own where given."""
    return model.render(view, gaussians=gaussians).image.float().cpu().numpy()


@torch.no_grad()
def rendered_with_depth(model: SplatModel, view: View) -> tuple[np.ndarray, np.ndarray]:
    """What the model shows, as `rendered`, and how far away it is (h, w), metres along the camera's axis."""
    picture = model.render(view, with_depth=True)
    return picture.image.float().cpu().numpy(), picture.depth.float().cpu().numpy()


def lateral_metrics(
    model: SplatModel, known: KnownTruth, camera: str, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """Per distance to the left, in metres, the metrics over all key frames of `camera` seen from there; None where
    there is no truth. What moves there is known from the boxes, whatever masks a user gave for the recorded images.

    The view lies from the recorded pose as the true one does from the true pose: where recorded poses are off, the
    picture is not held to an image of another place.
    """
    metrics, recording = RegionMetrics(lpips_map, LATERAL_REGIONS), known.recording
    frames = list(known.frames(camera))
    for index, truth in frames:
        frame, size = recording.frame(index), recording.size(index)
        to_left = inverse(np.array(truth.camera_to_global)) @ np.array(truth.lateral_camera_to_global)
        aside = dataclasses.replace(frame, camera_to_world=frame.camera_to_world @ to_left)
        pose = torch.from_numpy(aside.camera_to_world).float().to(device)
        view = dataclasses.replace(view_of(recording.parser, index, device), camera_to_world=pose)
        masks = region_masks(label_image(recording.scene, aside, size))
        metrics.add(rendered(model, view), known.image(truth.lateral, size), masks)
    return {str(known.truth.lateral_left_m): metrics.summary()} if frames else None


def removal_metrics(
    model: SplatModel, known: KnownTruth, camera: str, margin: float, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The street with the leading car removed against the street without it, over all key frames of `camera` that see
    the car: the pixels of its `box`, and those `outside`; under `not_removed` the same of the model as it is, which is
    what the removal is to beat. None where there is no truth."""
    recording = known.recording
    removed, untouched = RegionMetrics(lpips_map, REMOVAL_REGIONS), RegionMetrics(lpips_map, REMOVAL_REGIONS)
    measured = False
    for index, truth in known.frames(camera):
        seen = known.leading_in(index) if truth.without_leading else None
        if seen is None:
            continue
        box, inside = seen
        view, own_car = view_of(recording.parser, index, device), recording.own_car(index)
        with torch.no_grad():
            gaussians = model.gaussians_at(view.time)
            kept = gaussians[~removal_of(model, gaussians, box, margin).removed]
        street = known.image(truth.without_leading, recording.size(index))
        masks = {"box": inside & ~own_car, "outside": ~inside & ~own_car}
        removed.add(rendered(model, view, kept), street, masks)
        untouched.add(rendered(model, view, gaussians), street, masks)
        measured = True
    return {**removed.summary(), "not_removed": untouched.summary()} if measured else None
