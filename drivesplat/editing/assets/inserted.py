"""Assets as parts of a model, which show nothing until an edit places them."""

from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from drivesplat.editing.assets.asset import Asset
from drivesplat.model.actors import Actors
from drivesplat.model.deformable import Deformable
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import ActorTrack
from drivesplat.settings.train import GaussianSettings
from drivesplat.settings.train_objects import ActorSettings, DeformableSettings
from drivesplat.trajectories.motion import Motion

NEVER = -1e6
"""The second at which an asset's own track is: before every drive."""


def with_assets(model: SplatModel, assets: Mapping[str, Asset]) -> SplatModel:
    """The model with a part for each asset, whose object has the asset's key as its track id. The parts of the model
    are shared. Where the model renders LiDAR, an asset without echoes gets the mean ones of the model's objects, or
    else of all its Gaussians."""
    if not assets:
        return model
    device, echo = model.parts[0].params["means"].device, mean_lidar_logits(model)
    added = [part_of(key, asset, echo).to(device).requires_grad_(False) for key, asset in assets.items()]
    return SplatModel(
        [*model.parts, *added], model.sky, model.antialiased, model.exposure, model.rolling_shutter, model.max_scale
    )


def part_of(key: str, asset: Asset, echo: Tensor | None) -> Actors:
    """The part of a model that consists of an asset, as the object `key`. `echo` (4, 2) are the `lidar_logits` of an
    asset without any; None: the part has none."""
    gaussians, count = asset.gaussians, len(asset.gaussians)
    params = {
        "means": gaussians.means,
        "scales": torch.log(gaussians.scales),
        "quats": gaussians.quats,
        "opacities": torch.logit(gaussians.opacities.double(), eps=1e-7).float(),
        "sh0": gaussians.sh0[:, None],
        "shN": gaussians.shN[:, None],
        "owner": torch.zeros(count, dtype=torch.long),
    }
    if echo is not None:
        own = gaussians.lidar_logits
        params["lidar_logits"] = echo.cpu().repeat(count, 1, 1) if own is None else own
    pose = np.eye(4)[None]
    track = ActorTrack(key, np.asarray(asset.size), Motion(np.array([NEVER]), pose, ((0, 0),), 0.0), asset.object_class)
    params = {name: values.detach().clone() for name, values in params.items()}
    constant = {"fourier": 1, "sh_degree": gaussians.sh_degree}
    if asset.gait is None:
        return Actors(params, [track], ActorSettings(**constant), GaussianSettings())
    gait = asset.gait
    settings = DeformableSettings(**constant, gait=gait.settings, lattice=gait.lattice)
    part = Deformable(params, [track], settings, GaussianSettings())
    with torch.no_grad():
        part.shared["stride"] += torch.log(gait.cycle / part.cycle_lengths)
        part.shared["lattice"].copy_(gait.nodes[None])
    return part


def mean_lidar_logits(model: SplatModel) -> Tensor | None:
    """The `lidar_logits` (4, 2), the same in all directions, of the mean of the model's objects, or without any of all
    its Gaussians; None for a model that renders no LiDAR."""
    known = [part for part in model.parts if "lidar_logits" in part.params]
    if len(known) < len(model.parts):
        return None
    chosen = [part for part in known if part.has_objects and len(part)] or known
    mean = torch.cat([part.params["lidar_logits"][:, 0] for part in chosen]).detach().mean(dim=0)
    return torch.cat([mean[None], mean.new_zeros(3, 2)])
