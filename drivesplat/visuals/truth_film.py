"""The stage `truth_film`: a method from beside the recorded path, beside the truth of a synthetic world, as a film."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.errors import DatasetError
from drivesplat.evaluation.metrics import psnr_record
from drivesplat.evaluation.synthetic import DriveTruth, rendered
from drivesplat.evaluation.views_aside import LATERAL, place_of_view
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.readers.truth import TruthFrame
from drivesplat.rendering.captions import Caption
from drivesplat.rendering.film import encode_film
from drivesplat.rendering.panels import Panels
from drivesplat.scene.scene import Frame
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import FilmEncoding, TruthFilmJob
from drivesplat.visuals.beside_truth import even_size, film_rate, film_record, finite_image, panel_pictures, with_psnr

Place = tuple[str, int, Frame, TruthFrame]
"""A frame of the film: the key of a lateral view, a recorded image, the camera beside it, and the truth from there."""


def render_truth_film(
    checkpoint: TrainedCheckpoint,
    known: DriveTruth,
    method: str,
    job: TruthFilmJob,
    device_settings: DeviceSettings,
    path: Path,
) -> dict[str, Any]:
    """Writes the MP4 `path` of all key frames from beside the recorded path, one lateral view after the other: the true
    image, the rendering with its PSNR over the whole image, and its error. Returns the content of its JSON without
    provenance.

    Raises DatasetError where the world has no such view of the camera, DeviceError, and ResultError where the film
    cannot be written or a rendering contains NaN or Inf.
    """
    places, record = places_of(known, job.eval_camera), known.recording.record
    if not places:
        raise DatasetError(f"the truth of this world has no view of {job.eval_camera} from beside the path")
    panels = Panels(("ground truth", method, "error"), even_size(record.image_size(places[0][1])))
    model, device = open_model(checkpoint, device_settings)
    figures: list[dict[str, Any]] = []

    def frames() -> Iterator[tuple[np.ndarray, Caption]]:
        for key, index, camera, truth in places:
            image = finite_image(rendered(model, known.view(index, camera, device)), method)
            true = known.image(truth.image, record.image_size(index))
            found = psnr_record(image, true, np.ones(image.shape[:2], dtype=bool))
            seconds = record.seconds(index)
            figures.append({"left_m": float(key), "second": seconds, "psnr": found["psnr"] if found else None})
            labels = [panels.labels[0], with_psnr(method, found), panels.labels[-1]]
            caption = Caption(labels, [place_of_view((LATERAL, key)), "", ""], f"{seconds:.1f} s")
            yield panels.assembled(panel_pictures(true, image, panels=panels)), caption

    images = list(dict.fromkeys(index for _, index, _, _ in places))
    encoding = FilmEncoding(fps=film_rate(record.timestamps[images]), crf=job.crf, captions=job.captions)
    with explain_out_of_memory(lambda: len(model)):
        written = encode_film(path, frames(), len(places), panels, encoding)
    return film_record(job.eval_camera, encoding, panels, figures, written)


def places_of(known: DriveTruth, camera: str) -> list[Place]:
    """The frames of the film: by lateral view, in order of time."""
    timestamps = known.recording.record.timestamps
    found = []
    for view in known.truth.lateral(camera):
        frames = sorted(known.lateral_frames(view), key=lambda it: timestamps[it[0]])
        found += [(str(float(view.left_m)), *frame) for frame in frames]
    return found
