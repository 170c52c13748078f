"""The parameters of Gaussians, under the names and in the units that gsplat's strategies densify.

`means` (n, 3) metres, `scales` (n, 3) log metres, `quats` (n, 4) w, x, y, z, `opacities` (n,) logits, `sh0` and `shN`
spherical harmonics of degree 0 and of the degrees above; with semantic classes also `classes` (n, c) logits; with LiDAR
also `lidar_logits` (n, 4, 2), see `drivesplat.model.gaussians.Gaussians`, their directions in the frame of the
Gaussians, and where a LiDAR sees Gaussians elsewhere than cameras do, OFFSETS of their geometry.
"""

import math

import numpy as np
import torch
from jaxtyping import Bool
from scipy.spatial import cKDTree
from torch import Tensor, nn

from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.settings.train import GaussianSettings

OFFSETS = {
    "means": "lidar_means",
    "quats": "lidar_quats",
    "scales": "lidar_scales",
    "opacities": "lidar_opacities",
}
"""The parameters that a LiDAR adds to others, by the names of these."""
FADED = 1e-4
"""Opacity of a faded Gaussian, below the threshold at which every strategy removes or relocates it."""
MIN_VISIBLE = 0.005
"""Opacity below which every strategy removes or relocates a Gaussian with its default settings."""
_ROWS = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}
"""The shapes of rows of what all Gaussians have; `shN` for degree 0."""


def init_params(
    positions: np.ndarray,
    colors: np.ndarray,
    settings: GaussianSettings,
    classes: int = 0,
    lidar_logits: tuple[float, float] | None = None,
    offsets: bool = False,
) -> dict[str, Tensor]:
    """Parameters of Gaussians initialised at `positions` (n, 3) metres with `colors` (n, 3) in [0, 1], equal logits for
    all `classes`, `lidar_logits` of intensity and return (None: no LiDAR), and OFFSETS of 0 if wanted."""
    neighbours = min(4, len(positions))
    distances = cKDTree(positions).query(positions, k=neighbours, workers=-1)[0].reshape(len(positions), -1)[:, 1:]
    spacing = np.sqrt(np.mean(distances**2, axis=1)) if neighbours > 1 else np.ones(len(positions))
    scales = torch.from_numpy(np.log(np.maximum(spacing * settings.init_scale, 1e-4))).float()
    count = len(positions)
    geometry = {
        "means": torch.from_numpy(np.asarray(positions)).float(),
        "scales": scales[:, None].repeat(1, 3),
        "quats": torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1),
        "opacities": torch.full((count,), math.log(settings.init_opacity / (1.0 - settings.init_opacity))),
    }
    return {
        **geometry,
        "sh0": ((torch.from_numpy(np.asarray(colors)).float() - 0.5) / SH_C0)[:, None, :],
        "shN": torch.zeros(count, (settings.sh_degree + 1) ** 2 - 1, 3),
        **({"classes": torch.zeros(count, classes)} if classes else {}),
        **({} if lidar_logits is None else {"lidar_logits": _isotropic(count, lidar_logits)}),
        **({name: torch.zeros_like(geometry[of]) for of, name in OFFSETS.items()} if offsets else {}),
    }


def random_subset(count: int, limit: int) -> np.ndarray:
    """Indices of at most `limit` of `count`, in order."""
    if count <= limit:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).choice(count, limit, replace=False))


def _isotropic(count: int, logits: tuple[float, float]) -> Tensor:
    """The same logits in all directions."""
    found = torch.zeros(count, 4, 2)
    found[:, 0] = torch.tensor(logits)
    return found


def make_parameters(params: dict[str, Tensor]) -> nn.ParameterDict:
    """Tensors as parameters; integer and empty tensors are not learned."""
    return nn.ParameterDict(
        {
            key: nn.Parameter(value, requires_grad=value.is_floating_point() and value.numel() > 0)
            for key, value in params.items()
        }
    )


@torch.no_grad()
def fade(params: nn.ParameterDict, rows: Bool[Tensor, " n"]) -> None:
    """Makes Gaussians nearly transparent."""
    opacities, faded = params["opacities"], torch.logit(torch.tensor(FADED)).item()
    opacities.masked_fill_(rows & (opacities > faded), faded)


def require_rows(params: dict[str, Tensor], fourier: int | None = None, owners: int = 0) -> None:
    """Raises ValueError where `params` are not the rows of n Gaussians, whose colours vary with time by `fourier`
    coefficients (None: they do not), and which belong to so many `owners`."""
    lacking = [name for name in _ROWS if name not in params] + (["owner"] if fourier and "owner" not in params else [])
    if lacking:
        raise ValueError(f"it lacks {lacking[0]}")
    varying = () if fourier is None else (fourier,)
    expected = _ROWS | {lidar: _ROWS[name] for name, lidar in OFFSETS.items()}
    expected |= {"sh0": (*varying, 1, 3), "shN": (*varying, params["shN"].shape[-2], 3)}
    for name, values in params.items():
        kind = torch.int64 if name == "owner" else torch.float32
        shape = (params["means"].shape[:1], values.shape[1:] if name not in expected else expected[name])
        if values.dtype != kind or tuple(values.shape) != (*shape[0], *shape[1]):
            raise ValueError(f"{name} is {values.dtype} {list(values.shape)}")
    if math.isqrt(bases := params["shN"].shape[-2] + 1) ** 2 != bases:
        raise ValueError(f"shN is {list(params['shN'].shape)}")
    if owners and not ((params["owner"] >= 0) & (params["owner"] < owners)).all():
        raise ValueError("owner has indices out of range")


def learning_rates(settings: GaussianSettings, extent: float) -> dict[str, float]:
    """The initial learning rate of each parameter of Gaussians that spread over `extent` metres."""
    rates = {"means": settings.lr_means * extent, "scales": settings.lr_scales, "quats": settings.lr_quats}
    rates |= {"opacities": settings.lr_opacities, "sh0": settings.lr_sh0, "shN": settings.lr_shN}
    of_lidar = {offset: rates[name] for name, offset in OFFSETS.items()}
    return {**rates, **of_lidar, "classes": settings.lr_classes, "lidar_logits": settings.lr_lidar_logits}
