"""The stage `compare`: recorded images of the evaluated camera beside the renderings of several methods, as a film."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.errors import DatasetError
from drivesplat.evaluation.metrics import psnr_record
from drivesplat.evaluation.synthetic import rendered
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.rendering.captions import BEYOND, Caption
from drivesplat.rendering.film import encode_film
from drivesplat.rendering.panels import Panels
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import CompareJob, FilmEncoding
from drivesplat.visuals.beside_truth import (
    even_size,
    film_record,
    finite_image,
    image_rate,
    panel_pictures,
    with_psnr,
)

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

    recording: EvaluationData
    models: Mapping[str, SplatModel]
    device: torch.device
    panels: Panels
    figures: list[dict[str, Any]] = field(default_factory=list)

    def frames(self, images: Sequence[int]) -> Iterator[tuple[np.ndarray, Caption]]:
        """The picture and the caption of each image."""
        for index in images:
            truth, measured = self.recording.image(index), ~self.recording.ego_mask(index)
            view = view_of(self.recording.record, index, self.device)
            found = {name: finite_image(rendered(model, view), name) for name, model in self.models.items()}
            quality = {name: psnr_record(image, truth, measured) for name, image in found.items()}
            pictures = panel_pictures(truth, *found.values(), panels=self.panels)
            yield self.panels.assembled(pictures), self._caption(index, quality)

    def _caption(self, index: int, quality: Mapping[str, dict[str, Any] | None]) -> Caption:
        record, split = self.recording.record, self.recording.split(index)
        seconds = record.seconds(index)
        values = {name: found["psnr"] if found else None for name, found in quality.items()}
        self.figures.append({"second": seconds, "split": split, "psnr": values})
        first, *methods, last = self.panels.labels
        texts = [with_psnr(name, found) for name, found in zip(methods, quality.values(), strict=True)]
        notes = [NOTES.get(split or "", ""), *("" for _ in (*methods, last))]
        return Caption([first, *texts, last], notes, f"{seconds:.1f} s")


def render_comparison(
    checkpoints: Mapping[str, TrainedCheckpoint],
    recording: EvaluationData,
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
    labels = ("ground truth", *checkpoints, f"error of {[*checkpoints][-1]}")
    panels = Panels(labels, even_size(recording.size(images[0])))
    opened = {name: open_model(checkpoint, device_settings) for name, checkpoint in checkpoints.items()}
    models, (_, device) = {name: model for name, (model, _) in opened.items()}, next(iter(opened.values()))
    encoding = FilmEncoding(fps=image_rate(recording, images), crf=job.crf, captions=job.captions)
    comparison = _Comparison(recording, models, device, panels)
    with explain_out_of_memory(lambda: sum(map(len, models.values()))):
        written = encode_film(path, comparison.frames(images), len(images), panels, encoding)
    return film_record(job.eval_camera, encoding, panels, comparison.figures, written)


def images_of(recording: EvaluationData, camera: str) -> list[int]:
    """The indices of a camera's images by time. Raises DatasetError if the scene lacks that camera."""
    record = recording.record
    if camera not in record.camera_names:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(record.camera_names)})"
        )
    found = np.flatnonzero(record.camera_indices == record.camera_names.index(camera))
    return [int(index) for index in found[np.argsort(record.timestamps[found], kind="stable")]]
