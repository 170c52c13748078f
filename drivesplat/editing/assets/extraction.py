"""Assets of the actors of a trained model."""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch.nn.functional import normalize

from drivesplat.editing.assets.asset import Asset, AssetGait
from drivesplat.editing.assets.ground import ground_color
from drivesplat.io.storage import Provenance
from drivesplat.model.actors import Actors
from drivesplat.model.deformable import Deformable
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import TimeState
from drivesplat.scene.scene import Scene
from drivesplat.settings.images import HoldoutSettings
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.seen_sides import MIN_SHARE_TRAINED, TimedCameras

MIN_OPACITY = 0.005
"""The opacity from which a Gaussian belongs to an asset; fainter ones show nothing."""


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
