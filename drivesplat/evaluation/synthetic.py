"""Renderings compared with the truth of a synthetic world: images and depth from beside the recorded path, and the
street without the leading car."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from drivesplat.evaluation.metrics import (
    FrameErrors,
    LpipsMap,
    RegionMetrics,
    depth_summary,
    measuring_threads,
    relative_depth_errors,
)  # fmt: skip
from drivesplat.io.prefetch import prefetch
from drivesplat.io.storage import unreadable
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.removal import removal_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.readers.nuscenes.tokens import token
from drivesplat.readers.truth import (
    DEPTH_LIMIT,
    DEPTH_UNITS_PER_METRE,
    RULE,
    Truth,
    TruthFrame,
    TruthView,
    read_truth,
    truth_image,
)  # fmt: skip
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.images import continuous_intrinsics, read_image
from drivesplat.scene.regions import fill, hull_of, label_image, region_masks
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame
from drivesplat.scene.tracks import Box, box_at

SURFACES = {"road": ("road", "marking"), "markings": ("marking",)}
"""Regions of static pixels, each with its classes in true class images."""
LATERAL_REGIONS = ("all", "static", "moving_vehicle", *SURFACES)
REMOVAL_REGIONS = ("box", "outside")


@dataclass(frozen=True)
class DriveTruth:
    """The truth of a synthetic drive; `path` is that of its truth.json."""

    truth: Truth
    path: Path
    recording: EvaluationData

    @classmethod
    def read(cls, path: str | Path, recording: EvaluationData) -> "DriveTruth":
        """Reads truth.json. Raises ResultError that names the file and its rule if it is invalid."""
        return cls(read_truth(path), Path(path), recording)

    def frames(self, view: TruthView) -> Iterator[tuple[int, TruthFrame]]:
        """The indices of the recorded images that a view has truth for, each with its truth."""
        by_image = view.by_image()
        for index, frame in enumerate(self.recording.scene.frames):
            if frame.token in by_image:
                yield index, by_image[frame.token]

    def lateral_frames(self, view: TruthView) -> Iterator[tuple[int, Frame, TruthFrame]]:
        """The indices of the recorded images that a lateral view has truth for, each as taken from that view's offset,
        with its truth.

        The offset from the recorded pose is that between the true poses, so that errors of recorded poses do not shift
        the view against its true image.
        """
        recorded = self.truth.recorded(view.camera)
        true_poses = {token: frame.camera_to_global for token, frame in recorded.by_image().items()} if recorded else {}
        for index, truth in self.frames(view):
            if truth.token in true_poses:
                frame, true_pose = self.recording.frame(index), np.array(true_poses[truth.token])
                offset = inverse(true_pose) @ np.array(truth.camera_to_global)
                yield index, replace(frame, camera_to_world=frame.camera_to_world @ offset), truth

    def view(self, index: int, frame: Frame, device: torch.device) -> View:
        """The view of a recorded image as if taken from the pose of `frame`."""
        pose = torch.from_numpy(frame.camera_to_world).float().to(device)
        return replace(view_of(self.recording.record, index, device), camera_to_world=pose)

    def image(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """A true image (h, w, 3) in [0, 1] at `size` (width, height)."""
        return read_image(truth_image(self.path, name), size) / 255.0

    def class_images(self, camera: str) -> dict[int, str]:
        """The names of the true class images of a camera's recorded key frames, by the indices of its images."""
        recorded = self.truth.recorded(camera)
        return {index: truth.classes for index, truth in self.frames(recorded)} if recorded else {}

    def instance_of(self, name: str) -> str:
        """The instance of an object that an edit adds under this name."""
        return token(self.truth.scene, "instance", name)

    def number_of(self, name: str) -> int:
        """The number in instance images of an object that an edit adds under this name; -1 without any."""
        own = self.instance_of(name)
        return next((int(number) for number, known in self.truth.instances.items() if known == own), -1)

    def instances(self, name: str, size: tuple[int, int]) -> np.ndarray:
        """The true instance image (h, w) at `size` (width, height) by nearest neighbour: keys of `Truth.instances`."""
        return self._values(name, np.uint8, "L", "an instance image", size)

    def surfaces(self, name: str, static: np.ndarray) -> dict[str, np.ndarray]:
        """The masks (h, w) bool of SURFACES among the `static` pixels (h, w) bool, by the class image `name`."""
        classes = self._values(name, np.uint8, "L", "a class image", (static.shape[1], static.shape[0]))
        labels = {int(number): label for number, label in self.truth.classes.items()}
        found = {region: [n for n, label in labels.items() if label in own] for region, own in SURFACES.items()}
        return {region: static & np.isin(classes, numbers) for region, numbers in found.items()}

    def depth(self, name: str, size: tuple[int, int], mask: np.ndarray) -> PixelDepths:
        """The true depth of the pixels of a mask (h, w) bool, at `size` (width, height) by nearest neighbour; without
        pixels of the sky and those beyond the range of the image's format.

        Raises ResultError that names the image if it is not one of 16-bit depth.
        """
        values = self._values(name, np.uint16, "I", "a 16-bit depth image", size)
        rows, columns = np.nonzero(mask & (values > 0) & (values < DEPTH_LIMIT))
        return PixelDepths(rows, columns, values[rows, columns] / DEPTH_UNITS_PER_METRE)

    def _values(
        self, name: str, dtype: type[np.unsignedinteger], mode: str, kind: str, size: tuple[int, int]
    ) -> np.ndarray:
        """The values of a true image whose mode begins with `mode`, at `size` (width, height) by nearest neighbour.
        Raises ResultError that names the image if it is not of that `kind`."""
        path = truth_image(self.path, name)
        try:
            with Image.open(path) as image:
                if not image.mode.startswith(mode):
                    raise ValueError(f"its mode is {image.mode}")
                values = np.asarray(image).astype(dtype)
        except (OSError, UnidentifiedImageError, SyntaxError, ValueError) as error:
            raise unreadable(path, RULE, f"not {kind} ({error})", delete=self.path) from error
        return cv2.resize(values, size, interpolation=cv2.INTER_NEAREST_EXACT)

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


@torch.no_grad()
def rendered(model: SplatModel, view: View, gaussians: Gaussians | None = None) -> np.ndarray:
    """The rendering (h, w, 3) float32, not clamped; of `gaussians` in place of the model's own if given."""
    return model.render(view, gaussians=gaussians).image.float().cpu().numpy()


@torch.no_grad()
def rendered_with_depth(
    model: SplatModel, view: View, gaussians: Sequence[Gaussians] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """The rendering, as of `rendered`, and the depth (h, w) of its surfaces in metres along the camera's axis."""
    picture = model.render(view, gaussians=gaussians, with_surface_depth=True)
    assert picture.surface_depth is not None
    return picture.image.float().cpu().numpy(), picture.surface_depth.float().cpu().numpy()


def lateral_metrics(
    model: SplatModel, known: DriveTruth, camera: str, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The metrics of each lateral view of `camera` by its offset, in metres to the left (negative: to the right); None
    without truth."""
    views, fixed = known.truth.lateral(camera), FixedModel(model)
    found = {str(float(view.left_m)): _lateral_view_metrics(fixed, known, view, lpips_map, device) for view in views}
    return {offset: metrics for offset, metrics in found.items() if metrics} or None


def _lateral_view_metrics(
    fixed: FixedModel, known: DriveTruth, view: TruthView, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The metrics of a lateral view over all its key frames by region, and `depth`, over static pixels; None without
    key frames. Moving objects are known from boxes, whatever masks the user supplies for recorded images."""
    metrics, recording = RegionMetrics(lpips_map, LATERAL_REGIONS, device), known.recording
    frames, depth_errors = list(known.lateral_frames(view)), []
    Rendering = tuple[int, Frame, TruthFrame, np.ndarray, np.ndarray]

    def renderings() -> Iterator[Rendering]:
        for index, frame, truth in frames:
            seen_from = known.view(index, frame, device)
            shown = rendered_with_depth(fixed.model, seen_from, fixed.sample_in(seen_from))
            yield index, frame, truth, *shown

    def measure(one: Rendering) -> tuple[dict[str, FrameErrors], np.ndarray]:
        index, frame, truth, image, depth = one
        size = recording.size(index)
        masks = region_masks(label_image(recording.scene, frame, size))
        masks |= known.surfaces(truth.classes, masks["static"])
        errors = metrics.measure(image, known.image(truth.image, size), masks)
        return errors, relative_depth_errors(depth, known.depth(truth.depth, size, masks["static"]))

    for errors, of_depth in prefetch(measure, renderings(), measuring_threads()):
        metrics.add(errors)
        depth_errors.append(of_depth)
    return {**metrics.summary(), **depth_summary(depth_errors)} if frames else None


def removal_metrics(
    model: SplatModel, known: DriveTruth, camera: str, margin: float, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, Any] | None:
    """The rendering without the leading car against the true empty street, over all key frames of `camera` that see
    the car: metrics of the pixels in its `box` and `outside`. `not_removed` holds those of the unchanged model, the
    trivial baseline. None without truth."""
    recording, empty = known.recording, known.truth.without_leading(camera)
    if empty is None:
        return None
    fixed = FixedModel(model)
    removed, untouched = (RegionMetrics(lpips_map, REMOVAL_REGIONS, device) for _ in range(2))

    Rendering = tuple[int, str, np.ndarray, np.ndarray, np.ndarray]

    def renderings() -> Iterator[Rendering]:
        for index, truth in known.frames(empty):
            seen = known.leading_in(index)
            if seen is None:
                continue
            box, inside = seen
            view = view_of(recording.record, index, device)
            with torch.no_grad():
                gaussians = concatenate(fixed.sample_in(view))
                kept = gaussians[~removal_of(model, gaussians, box, margin).removed]
            yield index, truth.image, inside, rendered(model, view, kept), rendered(model, view, gaussians)

    def measure(one: Rendering) -> tuple[dict[str, FrameErrors], dict[str, FrameErrors]]:
        index, name, inside, without_car, with_car = one
        street, ego_mask = known.image(name, recording.size(index)), recording.ego_mask(index)
        masks = {"box": inside & ~ego_mask, "outside": ~inside & ~ego_mask}
        return removed.measure(without_car, street, masks), untouched.measure(with_car, street, masks)

    frames = list(prefetch(measure, renderings(), measuring_threads()))
    for without, with_it in frames:
        removed.add(without)
        untouched.add(with_it)
    return {**removed.summary(), "not_removed": untouched.summary()} if frames else None
