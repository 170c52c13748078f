"""The stage `actor_assets`: the actors of a trained model as assets, with a turntable of each and an index."""

import logging
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drivesplat.editing.assets.asset import TURNTABLE, write_asset
from drivesplat.editing.assets.completion import completed, filled
from drivesplat.editing.assets.extraction import assets_of
from drivesplat.editing.assets.turntable import write_turntable
from drivesplat.io.storage import Provenance, write_json
from drivesplat.io.unique_names import file_stems
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.scene.scene import Scene
from drivesplat.settings.asset_references import RECORD
from drivesplat.settings.export import AssetsJob

log = logging.getLogger(__name__)

SCHEMA = 1
COUNTS = ("gaussians", "invented")
"""What the log says of each asset."""


def write_assets(
    path: Path,
    scene: Scene,
    checkpoint: TrainedCheckpoint,
    method: str,
    job: AssetsJob,
    quality: Mapping[str, Mapping[str, Any]],
    provenance: Provenance,
) -> None:
    """Writes the index `path`, and beside it a folder for each actor of a trained model that a training image shows.
    `quality` are figures of objects on held-out images, by track. Folders of assets of earlier runs are removed."""
    for record in path.parent.glob(f"*/{RECORD}"):
        shutil.rmtree(record.parent)
    found = list(assets_of(trained_model(checkpoint), scene, job.holdout, method, quality, provenance))
    folders = file_stems(asset.source["track"] for asset in found)
    records = []
    for asset in found:
        track = asset.source["track"]
        whole = filled(completed(asset)) if job.complete else asset
        folder = path.parent / folders[track]
        record = write_asset(folder, whole)
        write_turntable(folder / TURNTABLE, whole)
        log.info("%s: %s, %d Gaussians, %d invented", track, asset.object_class.value, *(record[n] for n in COUNTS))
        records.append({"track": track, "folder": folders[track], **record})
    head = {"schema": SCHEMA, "scene": scene.name, "dataset": scene.dataset, "method": method}
    write_json(path, {**head, "assets": records, "provenance": provenance})
