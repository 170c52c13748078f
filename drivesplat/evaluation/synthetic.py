"""Renderings compared with the truth of a synthetic world: views from beside the recorded path, and the street without
the leading car."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.evaluation.metrics import FrameErrors, LpipsMap, RegionMetrics, measuring_threads
from drivesplat.io.prefetch import prefetch
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.removal import removal_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.readers.truth import Truth, TruthFrame, truth_image
from drivesplat.scene.images import continuous_intrinsics, read_image
from drivesplat.scene.prepared_drive import PreparedDrive
from drivesplat.scene.regions import fill, hull_of, label_image, region_masks
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame
from drivesplat.scene.tracks import Box, box_at

LATERAL_REGIONS = ("all", "static")
REMOVAL_REGIONS = ("box", "outside")


@dataclass(frozen=True)
class DriveTruth:
    """The truth of a synthetic drive; `path` is that of its truth.json."""

    truth: Truth
    path: Path
    recording: PreparedDrive

    def frames(self, camera: str) -> Iterator[tuple[int, TruthFrame]]:
        """The indices of the images of `camera` that have truth, each with its truth."""
        by_image = self.truth.by_image()
        for index, frame in enumerate(self.recording.scene.frames):
            if frame.camera == camera and frame.token in by_image:
                yield index, by_image[frame.token]

    def image(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """A true image (h, w, 3) in [0, 1] at `size` (width, height)."""
        return read_image(truth_image(self.path, name), size) / 255.0

    def leading_in(self, index: int) -> tuple[Box, np.ndarray] | None:
        """The box of the leading car in an image and the pixels (h, w) bool of its hull; None if it is not visible."""
        scene, frame, size = self.recording.scene, self.recording.frame(index), self.recording.size(index)
        leading = scene.track(self.truth.leading) if self.truth.leading else None
        box = box_at(leading, frame.timestamp, scene.key_frame_interval) if leading else None
        if box is None:
            return None
        hull = hull_of(box, inverse(frame.camera_to_world), continuous_intrinsics(frame, size))
        inside = fill(hull, size) if hull is not None else np.zeros(0, dtype=bool)
        return (box, inside) if inside.any() else None


@dataclass(frozen=True)
class RemovalRenderings:
    """Renderings (h, w, 3) of image `index` with the leading car `removed` and `untouched`, the name of the true image
    of the empty `street`, and the pixels `inside` (h, w) bool of the car's hull."""

    index: int
    street: str
    inside: np.ndarray
    removed: np.ndarray
    untouched: np.ndarray


@torch.no_grad()
def rendered(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """The rendering (h, w, 3) float32, not clamped; of `gaussians` in place of the model's own if given."""
    return model.render(view, gaussians=gaussians).image.float().cpu().numpy()


@torch.no_grad()
def rendered_with_depth(model: SplatModel, view: View) -> tuple[np.ndarray, np.ndarray]:
    """The rendering, as of `rendered`, and its depth (h, w) in metres along the camera's axis."""
    picture = model.render(view, with_depth=True)
    return picture.image.float().cpu().numpy(), picture.depth.float().cpu().numpy()


def lateral_metrics(
    model: SplatModel, known: DriveTruth, camera: str, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The metrics over all key frames of `camera`, by the distance to the left in metres from which they are rendered;
    None without truth. Moving objects are known from boxes, whatever masks the user supplies for recorded images.

    The offset from the recorded pose is that between the true poses, so that errors of recorded poses do not shift the
    view against its true image.
    """
    metrics, recording = RegionMetrics(lpips_map, LATERAL_REGIONS), known.recording
    frames = list(known.frames(camera))

    def renderings() -> Iterator[tuple[Frame, np.ndarray, TruthFrame, tuple[int, int]]]:
        for index, truth in frames:
            frame = recording.frame(index)
            to_left = inverse(np.array(truth.camera_to_global)) @ np.array(truth.lateral_camera_to_global)
            aside = dataclasses.replace(frame, camera_to_world=frame.camera_to_world @ to_left)
            pose = torch.from_numpy(aside.camera_to_world).float().to(device)
            view = dataclasses.replace(view_of(recording.record, index, device), camera_to_world=pose)
            yield aside, rendered(model, view), truth, recording.size(index)

    def measure(one: tuple[Frame, np.ndarray, TruthFrame, tuple[int, int]]) -> dict[str, FrameErrors]:
        aside, image, truth, size = one
        masks = region_masks(label_image(recording.scene, aside, size))
        return metrics.measure(image, known.image(truth.lateral, size), masks)

    for errors in prefetch(measure, renderings(), measuring_threads()):
        metrics.add(errors)
    return {str(known.truth.lateral_left_m): metrics.summary()} if frames else None


def removal_metrics(
    model: SplatModel, known: DriveTruth, camera: str, margin: float, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The rendering without the leading car against the true empty street, over all key frames of `camera` that see
    the car: metrics of the pixels in its `box` and `outside`. `not_removed` holds those of the unchanged model, the
    trivial baseline. None without truth."""
    recording = known.recording
    removed, untouched = RegionMetrics(lpips_map, REMOVAL_REGIONS), RegionMetrics(lpips_map, REMOVAL_REGIONS)

    def renderings() -> Iterator[RemovalRenderings]:
        for index, truth in known.frames(camera):
            seen = known.leading_in(index) if truth.without_leading else None
            if seen is None:
                continue
            box, inside = seen
            view = view_of(recording.record, index, device)
            with torch.no_grad():
                gaussians = model.gaussians_at(view.time)
                kept = gaussians[~removal_of(model, gaussians, box, margin).removed]
            pictures = rendered(model, view, kept), rendered(model, view, gaussians)
            yield RemovalRenderings(index, truth.without_leading, inside, *pictures)

    def measure(one: RemovalRenderings) -> tuple[dict[str, FrameErrors], dict[str, FrameErrors]]:
        street, ego_mask = known.image(one.street, recording.size(one.index)), recording.ego_mask(one.index)
        masks = {"box": one.inside & ~ego_mask, "outside": ~one.inside & ~ego_mask}
        return removed.measure(one.removed, street, masks), untouched.measure(one.untouched, street, masks)

    frames = list(prefetch(measure, renderings(), measuring_threads()))
    for without, with_it in frames:
        removed.add(without)
        untouched.add(with_it)
    return {**removed.summary(), "not_removed": untouched.summary()} if frames else None
