"""The stage `compare`: recorded images of the evaluated camera beside the renderings of several methods, as a film."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.evaluation.metrics import psnr_record
from drivesplat.evaluation.synthetic import rendered
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.view import view_of
from drivesplat.rendering.captions import BEYOND, Caption
from drivesplat.rendering.film import encode_film
from drivesplat.rendering.panels import Panels
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import CompareJob, FilmEncoding
from drivesplat.visuals.beside_truth import even_size, film_rate, film_record, finite_image, panel_pictures, with_psnr

NOTES = {
    "train": "training image",
    "interpolation": "held out",
    "extrapolation": f"held out, {BEYOND}",
    "excluded": "neither trained on nor measured",
}
"""What a caption says of the split of an image."""


def render_comparison(
    checkpoints: Mapping[str, TrainedCheckpoint],
    recording: EvaluationData,
    job: CompareJob,
    device_settings: DeviceSettings,
    path: Path,
) -> dict[str, Any]:
    """Writes the MP4 `path` of the recorded images of the evaluated camera in order, trained on or held out, up to
    where `job.end` says, at the size and rate at which they were recorded for training: the image, the rendering of
    each method with its PSNR over the whole image, and the error of the last method. Returns the content of its JSON
    without provenance.

    Raises DatasetError where the scene lacks the camera, DeviceError, and ResultError where the film cannot be written
    or a rendering contains NaN or Inf.
    """
    record, images = recording.record, shown_images(recording, job)
    first, last = "ground truth", f"error of {[*checkpoints][-1]}"
    panels = Panels((first, *checkpoints, last), even_size(recording.size(images[0])))
    opened = {name: open_model(checkpoint, device_settings) for name, checkpoint in checkpoints.items()}
    models, (_, device) = {name: model for name, (model, _) in opened.items()}, next(iter(opened.values()))
    figures: list[dict[str, Any]] = []

    def frames() -> Iterator[tuple[np.ndarray, Caption]]:
        for index in images:
            truth, measured = recording.image(index), ~recording.ego_mask(index)
            view = view_of(record, index, device)
            shown = {name: finite_image(rendered(model, view), name) for name, model in models.items()}
            found = {name: psnr_record(image, truth, measured) for name, image in shown.items()}
            seconds, split = record.seconds(index), recording.split(index)
            values = {name: quality["psnr"] if quality else None for name, quality in found.items()}
            figures.append({"second": seconds, "split": split, "psnr": values})
            texts = [with_psnr(name, quality) for name, quality in found.items()]
            notes = [NOTES.get(split or "", ""), *("" for _ in (*texts, last))]
            pictures = panel_pictures(truth, *shown.values(), panels=panels)
            yield panels.assembled(pictures), Caption([first, *texts, last], notes, f"{seconds:.1f} s")

    encoding = FilmEncoding(fps=film_rate(record.timestamps[images]), crf=job.crf, captions=job.captions)
    with explain_out_of_memory(lambda: sum(map(len, models.values()))):
        written = encode_film(path, frames(), len(images), panels, encoding)
    return film_record(job.eval_camera, encoding, panels, figures, written)


def shown_images(recording: EvaluationData, job: CompareJob) -> list[int]:
    """The indices of the film's images by time: up to where `job.end` says; all where none is a training image. Raises
    what `images_of` raises."""
    images = images_of(recording, job.eval_camera)
    trained = [place for place, index in enumerate(images) if recording.split(index) == "train"]
    return images[: trained[-1] + 1] if job.end == "trained" and trained else images


def images_of(recording: EvaluationData, camera: str) -> list[int]:
    """The indices of a camera's images by time. Raises DatasetError if the scene lacks that camera."""
    record = recording.record
    if camera not in record.camera_names:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(record.camera_names)})"
        )
    found = np.flatnonzero(record.camera_indices == record.camera_names.index(camera))
    return [int(index) for index in found[np.argsort(record.timestamps[found], kind="stable")]]
