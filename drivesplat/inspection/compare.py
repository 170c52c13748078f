"""The stage `compare`: recorded images of the evaluated camera beside the renderings of several methods, as a film."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps

from drivesplat.errors import DatasetError, ResultError
from drivesplat.evaluation.metrics import psnr_record
from drivesplat.evaluation.synthetic import rendered
from drivesplat.inspection.drawing import MAX_ERROR
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.rendering.captions import BEYOND, Caption
from drivesplat.rendering.film import encode_film
from drivesplat.rendering.panels import Panels
from drivesplat.scene.prepared_drive import PreparedDrive
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import CompareJob, FilmEncoding

NOTES = {
    "train": "training image",
    "interpolation": "held out",
    "extrapolation": f"held out, {BEYOND}",
    "excluded": "neither trained on nor measured",
}
"""What a caption says of the split of an image."""


@dataclass(frozen=True)
class _Comparison:
    """A recording with the models of several methods, and the figures of each image compared so far."""

    recording: PreparedDrive
    models: Mapping[str, SplatModel]
    device: torch.device
    panels: Panels
    figures: list[dict[str, Any]] = field(default_factory=list)

    def frames(self, images: Sequence[int]) -> Iterator[tuple[np.ndarray, Caption]]:
        """The picture and the caption of each image."""
        for index in images:
            truth, measured = self.recording.image(index), ~self.recording.ego_mask(index)
            view = view_of(self.recording.record, index, self.device)
            found = {name: self._rendering(model, name, view) for name, model in self.models.items()}
            quality = {name: psnr_record(image, truth, measured) for name, image in found.items()}
            error = np.abs([*found.values()][-1] - truth).mean(axis=2)
            colored = colormaps["inferno"](error / MAX_ERROR)[..., :3]
            width, height = self.panels.size
            pictures = [_to_bytes(image[:height, :width]) for image in (truth, *found.values(), colored)]
            yield self.panels.assembled(pictures), self._caption(index, quality)

    def _rendering(self, model: SplatModel, name: str, view: Any) -> np.ndarray:
        image = rendered(model, view)
        if not np.isfinite(image).all():
            raise ResultError(f"a rendering of {name} contains NaN or Inf; delete its checkpoint.npz and rerun")
        return image.clip(0.0, 1.0)

    def _caption(self, index: int, quality: Mapping[str, dict[str, Any] | None]) -> Caption:
        record, split = self.recording.record, self.recording.split(index)
        seconds = record.seconds(index)
        values = {name: found["psnr"] if found else None for name, found in quality.items()}
        self.figures.append({"second": seconds, "split": split, "psnr": values})
        first, *methods, last = self.panels.labels
        texts = [_with_psnr(name, found) for name, found in zip(methods, quality.values(), strict=True)]
        notes = [NOTES.get(split or "", ""), *("" for _ in (*methods, last))]
        return Caption([first, *texts, last], notes, f"{seconds:.1f} s")


def render_comparison(
    checkpoints: Mapping[str, TrainedCheckpoint],
    recording: PreparedDrive,
    job: CompareJob,
    device_settings: DeviceSettings,
    path: Path,
) -> dict[str, Any]:
    """Writes the MP4 `path` of the recorded images of the evaluated camera in order, trained on or held out, at the
    size and rate at which they were recorded for training: the image, the rendering of each method with its PSNR over
    the whole image, and the error of the last method. Returns the content of its JSON without provenance.

    Raises DatasetError where the scene lacks the camera, DeviceError, and ResultError where the film cannot be written
    or a rendering contains NaN or Inf.
    """
    images = images_of(recording, job.eval_camera)
    width, height = recording.size(images[0])
    labels = ("ground truth", *checkpoints, f"error of {[*checkpoints][-1]}")
    panels = Panels(labels, (max(2, width // 2 * 2), max(2, height // 2 * 2)))
    opened = {name: open_model(checkpoint, device_settings) for name, checkpoint in checkpoints.items()}
    models, (_, device) = {name: model for name, (model, _) in opened.items()}, next(iter(opened.values()))
    encoding = FilmEncoding(fps=image_rate(recording, images), crf=job.crf, captions=job.captions)
    comparison = _Comparison(recording, models, device, panels)
    with explain_out_of_memory(lambda: sum(map(len, models.values()))):
        figures = encode_film(path, comparison.frames(images), len(images), panels, encoding)
    return {
        "schema": 1,
        "camera": job.eval_camera,
        "fps": encoding.fps,
        "frames": len(images),
        "film": panels.record(),
        "images": comparison.figures,
        **figures,
    }


def images_of(recording: PreparedDrive, camera: str) -> list[int]:
    """The indices of a camera's images by time. Raises DatasetError if the scene lacks that camera."""
    record = recording.record
    if camera not in record.camera_names:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(record.camera_names)})"
        )
    found = np.flatnonzero(record.camera_indices == record.camera_names.index(camera))
    return [int(index) for index in found[np.argsort(record.timestamps[found], kind="stable")]]


def image_rate(recording: PreparedDrive, images: Sequence[int]) -> int:
    """Images a second, rounded, at least 1."""
    times = recording.record.timestamps[list(images)]
    return max(1, round(1e6 / float(np.median(np.diff(times))))) if len(images) > 1 else 1


def _with_psnr(name: str, found: dict[str, Any] | None) -> str:
    if found is None:
        return name
    return f"{name}, identical" if found["psnr"] is None else f"{name}, {found['psnr']:.1f} dB"


def _to_bytes(colors: np.ndarray) -> np.ndarray:
    """Colours in [0, 1] as the nearest uint8."""
    return (colors * 255.0 + 0.5).astype(np.uint8)
