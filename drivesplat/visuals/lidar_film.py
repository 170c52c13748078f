"""The stage `lidar_film`: all recorded scans of a LiDAR beside those of a trained model, as a film."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.evaluation.comparison import GROUP_PLACES
from drivesplat.evaluation.scan_metrics import scan_metrics
from drivesplat.rendering.captions import Caption
from drivesplat.rendering.film import encode_film
from drivesplat.rendering.panels import Panels
from drivesplat.settings.render import FilmEncoding, LidarFilmJob
from drivesplat.visuals.beside_truth import film_rate
from drivesplat.visuals.lidar_frame import SIZE, LidarFrames
from drivesplat.visuals.lidar_picture import figures_label
from drivesplat.visuals.trained_lidar import TrainedLidar, heading

NOTES = {
    "train": "training scan",
    **{group: f"held out {place}" for group, place in GROUP_PLACES.items()},
    "excluded": "neither trained on nor measured",
}
"""What a caption says of the split of a scan."""


def render_lidar_film(lidar: TrainedLidar, method: str, job: LidarFilmJob, path: Path) -> dict[str, Any]:
    """Writes the MP4 `path` of all scans in order of time, at the rate at which they were recorded: range image and top
    view, recorded and rendered. Returns the content of its JSON without provenance, with the figures of each scan.

    Raises DeviceError, and ResultError where the film cannot be written or a rendering contains NaN or Inf.
    """
    title = f"Scene {lidar.scene.name} · {method} · {lidar.name}"
    drawn, panels = LidarFrames(lidar.scans, heading(lidar.scans), title), Panels((lidar.name,), SIZE)
    figures: list[dict[str, Any]] = []

    def frames() -> Iterator[tuple[np.ndarray, Caption]]:
        for recorded in lidar.scans:
            rendered = lidar.render(recorded)
            found = scan_metrics(lidar.scene, [(recorded, rendered)], chamfer=False)["all"]
            measured = {name: value for name, value in found.items() if name != "chamfer_m"}
            figures.append({"second": recorded.seconds, "split": recorded.group, **measured})
            caption = Caption([figures_label(found)], [NOTES[recorded.group]], f"{recorded.seconds:.1f} s")
            yield drawn.frame(recorded, rendered), caption

    rate = film_rate([scan.timestamp for scan in lidar.scans])
    encoding = FilmEncoding(fps=rate, crf=job.crf, captions=job.captions)
    written = encode_film(path, frames(), len(lidar.scans), panels, encoding)
    return {
        "schema": 1,
        "lidar": lidar.name,
        "fps": rate,
        "frames": len(lidar.scans),
        "width": SIZE[0],
        "height": SIZE[1],
        "reach_m": drawn.reach,
        "scans": figures,
        **written,
    }
