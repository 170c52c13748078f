"""Renderings against the truth that only a synthetic world knows: the street from beside the recorded path, and the
street without the car ahead."""

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.evaluation.metrics import FrameErrors, LpipsMap, RegionMetrics, measuring_threads
from drivesplat.io.prefetch import ahead
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.removal import removal_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.readers.truth import Truth, TruthFrame, truth_image
from drivesplat.scene.images import continuous_intrinsics, read_image
from drivesplat.scene.prepared_drive import Recording
from drivesplat.scene.regions import fill, hull_of, label_image, region_masks
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame
from drivesplat.scene.tracks import Box, box_at

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


@dataclass(frozen=True)
class Emptied:
    """Image `index` as a model shows it (h, w, 3), with the leading car `removed` and `untouched`, beside the name of
    the true image of the empty `street`; `inside` (h, w) bool are the pixels of the car's hull."""

    index: int
    street: str
    inside: np.ndarray
    removed: np.ndarray
    untouched: np.ndarray


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

    def shown() -> Iterator[tuple[Frame, np.ndarray, TruthFrame, tuple[int, int]]]:
        for index, truth in frames:
            frame = recording.frame(index)
            to_left = inverse(np.array(truth.camera_to_global)) @ np.array(truth.lateral_camera_to_global)
            aside = dataclasses.replace(frame, camera_to_world=frame.camera_to_world @ to_left)
            pose = torch.from_numpy(aside.camera_to_world).float().to(device)
            view = dataclasses.replace(view_of(recording.record, index, device), camera_to_world=pose)
            yield aside, rendered(model, view), truth, recording.size(index)

    def measured(one: tuple[Frame, np.ndarray, TruthFrame, tuple[int, int]]) -> dict[str, FrameErrors]:
        aside, image, truth, size = one
        masks = region_masks(label_image(recording.scene, aside, size))
        return metrics.measured(image, known.image(truth.lateral, size), masks)

    for errors in ahead(measured, shown(), measuring_threads()):
        metrics.add(errors)
    return {str(known.truth.lateral_left_m): metrics.summary()} if frames else None


def removal_metrics(
    model: SplatModel, known: KnownTruth, camera: str, margin: float, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The street with the leading car removed against the street without it, over all key frames of `camera` that see
    the car: the pixels of its `box`, and those `outside`; under `not_removed` the same of the model as it is, which is
    what the removal is to beat. None where there is no truth."""
    recording = known.recording
    removed, untouched = RegionMetrics(lpips_map, REMOVAL_REGIONS), RegionMetrics(lpips_map, REMOVAL_REGIONS)

    def shown() -> Iterator[Emptied]:
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
            yield Emptied(index, truth.without_leading, inside, *pictures)

    def measured(one: Emptied) -> tuple[dict[str, FrameErrors], dict[str, FrameErrors]]:
        street, own_car = known.image(one.street, recording.size(one.index)), recording.own_car(one.index)
        masks = {"box": one.inside & ~own_car, "outside": ~one.inside & ~own_car}
        return removed.measured(one.removed, street, masks), untouched.measured(one.untouched, street, masks)

    frames = list(ahead(measured, shown(), measuring_threads()))
    for without, with_it in frames:
        removed.add(without)
        untouched.add(with_it)
    return {**removed.summary(), "not_removed": untouched.summary()} if frames else None
