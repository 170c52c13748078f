"""The stage `actor_assets`: the actors of a trained model as assets, with a turntable of each and an index."""

import logging
import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn.functional import normalize

from drivesplat.editing.assets.asset import TURNTABLE, Asset, AssetGait, write_asset
from drivesplat.editing.assets.completion import completed, filled
from drivesplat.editing.assets.ground import ground_color
from drivesplat.editing.assets.turntable import write_turntable
from drivesplat.io.storage import Provenance, write_json
from drivesplat.io.unique_names import file_stems
from drivesplat.model.actors import Actors
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.model.deformable import Deformable
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import TimeState
from drivesplat.scene.scene import Scene
from drivesplat.settings.asset_references import RECORD
from drivesplat.settings.export import AssetsJob
from drivesplat.settings.images import HoldoutSettings
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.seen_sides import MIN_SHARE_TRAINED, TimedCameras

log = logging.getLogger(__name__)
SCHEMA = 1
COUNTS = ("gaussians", "invented")
"""What the log says of each asset."""
MIN_OPACITY = 0.005
"""The opacity from which a Gaussian belongs to an asset; fainter ones show nothing."""


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


def assets_of(
    model: SplatModel,
    scene: Scene,
    holdout: HoldoutSettings,
    method: str,
    quality: Mapping[str, Mapping[str, Any]],
    provenance: Provenance,
) -> Iterator[Asset]:
    """The actors of a trained model as assets, but for those that no training image shows. Their names are `{scene}/
    {method}/{track}`. `quality` are their figures on held-out images, by track."""
    cameras = TimedCameras.of_training(scene, holdout)
    for part in model.parts:
        if not isinstance(part, Actors):
            continue
        for number, (track_id, group) in enumerate(part.rigid_groups(0.0).items()):
            track = scene.track(track_id)
            if track is None or group.motion is None:
                continue
            actor = EditedActor.recorded(track.id, track.object_class, track.category, track.size, group.motion)
            shares, azimuths = cameras.shares(actor), cameras.azimuths(actor)
            if not (shares >= MIN_SHARE_TRAINED).any():
                continue
            best = float(cameras.seconds[shares.argmax()])
            gaussians = _gaussians(part, number, best)
            if not len(gaussians):
                continue
            pose = actor.poses(np.array([best]))[0]
            yield Asset(
                name=f"{scene.name}/{method}/{track.id}",
                object_class=track.object_class,
                category=track.category,
                size=track.size,
                gaussians=gaussians,
                invented=torch.zeros(len(gaussians), dtype=torch.bool),
                gait=_gait(part, number) if isinstance(part, Deformable) else None,
                seen=np.unique(azimuths[~np.isnan(azimuths)].round(4)),
                source={"dataset": scene.dataset, "scene": scene.name, "method": method, "track": track.id},
                quality=quality.get(track.id, {}),
                ground=ground_color(model, best, pose, float(track.size[2])),
                provenance=provenance,
            )


@torch.no_grad()
def _gaussians(part: Actors, number: int, time: float) -> Gaussians:
    """Those of an object in its frame, undeformed, with the colours of a time."""
    p, series = part.params, TimeState(*part.state(time).now).series[number]
    rows = (p["owner"] == number) & (torch.sigmoid(p["opacities"]) >= MIN_OPACITY)
    for values in p.values():
        rows &= torch.isfinite(values).reshape(len(values), -1).all(dim=1)
    sh0, shN = ((p[name][rows] * series[:, None, None]).sum(dim=1) for name in ("sh0", "shN"))
    quats, scales = normalize(p["quats"][rows], dim=-1), torch.exp(p["scales"][rows])
    logits = p["lidar_logits"][rows] if "lidar_logits" in p else None
    opacities = torch.sigmoid(p["opacities"][rows])
    return Gaussians(p["means"][rows], quats, scales, opacities, sh0, shN, lidar_logits=logits)


def _gait(part: Deformable, number: int) -> AssetGait:
    """How an object walks, without the changes of its shape over time."""
    settings = part.settings
    nodes = part.shared["lattice"][number, : 2 * settings.gait.harmonics].detach().clone()
    return AssetGait(float(part.cycle_lengths[number]), settings.gait, settings.lattice, nodes)
