"""The stage `truth_film`: a method from beside the recorded path, beside the truth of a synthetic world, as a film."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.errors import DatasetError
from drivesplat.evaluation.metrics import psnr_record
from drivesplat.evaluation.synthetic import DriveTruth, rendered
from drivesplat.evaluation.views_aside import LATERAL, place_of_view
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.splat_model import SplatModel
from drivesplat.readers.truth import TruthFrame
from drivesplat.rendering.captions import Caption
from drivesplat.rendering.film import encode_film
from drivesplat.rendering.panels import Panels
from drivesplat.scene.scene import Frame
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

Place = tuple[str, int, Frame, TruthFrame]
"""A frame of the film: the key of a lateral view, a recorded image, the camera beside it, and the truth from there."""


@dataclass(frozen=True)
class _Sideways:
    """A model beside the truth, and the figures of the frames rendered so far."""

    known: DriveTruth
    model: SplatModel
    method: str
    device: torch.device
    panels: Panels
    figures: list[dict[str, Any]] = field(default_factory=list)

    def frames(self, places: Sequence[Place]) -> Iterator[tuple[np.ndarray, Caption]]:
        """The picture and the caption of each place."""
        record = self.known.recording.record
        for key, index, camera, truth in places:
            image = finite_image(rendered(self.model, self.known.view(index, camera, self.device)), self.method)
            true = self.known.image(truth.image, record.image_size(index))
            found = psnr_record(image, true, np.ones(image.shape[:2], dtype=bool))
            seconds = record.seconds(index)
            self.figures.append({"left_m": float(key), "second": seconds, "psnr": found["psnr"] if found else None})
            labels = [self.panels.labels[0], with_psnr(self.method, found), self.panels.labels[-1]]
            caption = Caption(labels, [place_of_view((LATERAL, key)), "", ""], f"{seconds:.1f} s")
            yield self.panels.assembled(panel_pictures(true, image, panels=self.panels)), caption


def render_truth_film(
    checkpoint: TrainedCheckpoint,
    known: DriveTruth,
    method: str,
    job: CompareJob,
    device_settings: DeviceSettings,
    path: Path,
) -> dict[str, Any]:
    """Writes the MP4 `path` of all key frames from beside the recorded path, one lateral view after the other: the true
    image, the rendering with its PSNR over the whole image, and its error. Returns the content of its JSON without
    provenance.

    Raises DatasetError where the world has no such view of the camera, DeviceError, and ResultError where the film
    cannot be written or a rendering contains NaN or Inf.
    """
    places = places_of(known, job.eval_camera)
    if not places:
        raise DatasetError(f"the truth of this world has no view of {job.eval_camera} from beside the path")
    panels = Panels(("ground truth", method, "error"), even_size(known.recording.size(places[0][1])))
    model, device = open_model(checkpoint, device_settings)
    images = list(dict.fromkeys(index for _, index, _, _ in places))
    encoding = FilmEncoding(fps=image_rate(known.recording, images), crf=job.crf, captions=job.captions)
    sideways = _Sideways(known, model, method, device, panels)
    with explain_out_of_memory(lambda: len(model)):
        written = encode_film(path, sideways.frames(places), len(places), panels, encoding)
    return film_record(job.eval_camera, encoding, panels, sideways.figures, written)


def places_of(known: DriveTruth, camera: str) -> list[Place]:
    """The frames of the film: by lateral view, in order of time."""
    timestamps = known.recording.record.timestamps
    found = []
    for view in known.truth.lateral(camera):
        frames = sorted(known.lateral_frames(view), key=lambda it: timestamps[it[0]])
        found += [(str(float(view.left_m)), *frame) for frame in frames]
    return found
