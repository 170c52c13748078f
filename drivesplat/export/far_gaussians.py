"""The stage `far_gaussians`: which Gaussians lie too far away for other programs, and what becomes of them in exports.

A training keeps Gaussians within `train.max_distance`. Without it, and where exports ask for less, Gaussians lie up to
a thousand kilometres away: nothing pulls one back that no image shows. They make bounding boxes infinite and use up the
16 bits by which web viewers sort. Beyond `max_distance` from the world's origin

1. Gaussians are removed: all of them if that changes no pixel of any training view by more than MAX_CHANGE, which is
   measured by rendering every training view with and without them. What is seen instead is the sky model.
2. Otherwise only those that provably do not matter are removed: a set whose contributions to each view, summed over its
   pixels, are below MAX_CHANGE together. The others are moved along the line of sight into the outermost tenth of
   the distance, and shrunk alike, which a camera at the centre of the movement does not see. The centre is the mean of
   the training cameras, weighted by what each sees of the Gaussian. Cameras elsewhere see a parallax: the largest
   change of a training view is measured and, above MAX_CHANGE, reported as a warning.

Either way no Gaussian is left beyond the distance.
"""

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from drivesplat.io.array_file import read_typed_arrays
from drivesplat.io.storage import Provenance
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model, trained_model
from drivesplat.model.reach import INSIDE, reach_of
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.device import DeviceSettings

log = logging.getLogger(__name__)

RULE = "far_gaussians"
MAX_CHANGE = 1.0 / 255.0
"""The largest change of a pixel of a training view: one step of 8 bits."""
SHELL = 0.9
"""Moved Gaussians lie between this share of the distance and the distance, in their order."""


@dataclass(frozen=True)
class FarGaussians:
    """What exports change in a model: of the rows of all parts in order, `removed` (r,) are dropped, and `moved` (m,)
    get the positions `means` (m, 3) in metres and `shrink` (m,) times their scales. `largest_change` of a pixel, in
    [0, 1], over `views` training views."""

    removed: Int[np.ndarray, " r"]
    moved: Int[np.ndarray, " m"]
    means: Float[np.ndarray, "m 3"]
    shrink: Float[np.ndarray, " m"]
    largest_change: float
    views: int
    provenance: Provenance


def find_far_in(
    checkpoint: TrainedCheckpoint,
    record: TrainingRecord,
    max_distance: float,
    provenance: Provenance,
    device_settings: Callable[[], DeviceSettings],
) -> FarGaussians:
    """`find_far` of the model in a checkpoint, by the training views of `record`. The device of `device_settings` is
    opened, and the settings are asked for, only where a Gaussian lies too far away."""
    model, views = trained_model(checkpoint), _training_views(record, torch.device("cpu"))
    reach, distances = _reach_and_distances(model, views, max_distance)
    if (distances > reach).any():
        model, device = open_model(checkpoint, device_settings())
        views = _training_views(record, device)
    return find_far(model, views, max_distance, provenance)


@torch.no_grad()
def find_far(model: SplatModel, views: Sequence[View], max_distance: float, provenance: Provenance) -> FarGaussians:
    """Decides on the Gaussians of a model that lie too far away, by its training `views` on the model's device.

    Static Gaussians are measured from the world's origin; those of objects from the centre of their box, and removed.
    Positions that are NaN or Inf are not considered: exports drop them.
    """
    reach, distances = _reach_and_distances(model, views, max_distance)
    rows = (distances > reach).nonzero()[:, 0]
    summary = f"{len(rows)} of {len(distances)} Gaussians lie beyond {reach:.0f} m"
    if len(rows) == 0:
        log.info("%s", summary)
        return _changes(rows, provenance)
    summary += f" (the farthest at {float(distances[rows].max()):.0f} m)"
    changes = _changes(rows, provenance, views=len(views))
    changes = replace(changes, largest_change=_largest_change(model, changes, views))
    if changes.largest_change <= MAX_CHANGE:
        log.info("%s: left out, a change of %.2f/255 at most", summary, 255 * changes.largest_change)
        return changes
    visibility, centers = _visibility(model, rows, views)
    # Of the least visible, as many are negligible as together contribute at most MAX_CHANGE to any view. Removing them
    # changes no pixel by more: what they leave goes to what lies behind, whose colours are in [0, 1] as theirs.
    order = torch.argsort(visibility)
    negligible = torch.empty_like(visibility, dtype=torch.bool)
    negligible[order] = visibility[order].cumsum(dim=0) <= MAX_CHANGE
    seen = ~model.moving()[rows] & ~negligible
    means, shrink = _nearer(torch.cat([part.params["means"] for part in model.parts])[rows[seen]], centers[seen], reach)
    changes = replace(
        _changes(rows[~seen], provenance, views=len(views)), moved=_array(rows[seen]), means=means, shrink=shrink
    )
    changes = replace(changes, largest_change=_largest_change(model, changes, views))
    log.log(
        logging.INFO if changes.largest_change <= MAX_CHANGE else logging.WARNING,
        "%s: training views show %d of them, which exports show nearer, a change of %.2f/255 at most",
        summary, len(means), 255 * changes.largest_change,
    )  # fmt: skip
    return changes


def _training_views(record: TrainingRecord, device: torch.device) -> list[View]:
    return [view_of(record, index, device) for index in record.train_images]


@torch.no_grad()
def _reach_and_distances(
    model: SplatModel, views: Sequence[View], max_distance: float
) -> tuple[float, Float[Tensor, " n"]]:
    """How far Gaussians may lie, and how far those of all parts do, in metres; 0 for positions that are NaN or Inf."""
    reach = reach_of(torch.stack([view.camera_to_world[:3, 3] for view in views]), max_distance)
    distances = torch.cat([part.params["means"].double().norm(dim=1) for part in model.parts])
    return reach, torch.where(distances.isfinite(), distances, 0.0)


def within_reach(checkpoint: TrainedCheckpoint, far: FarGaussians) -> TrainedCheckpoint:
    """A checkpoint with the changes of `far`, which was found in its model."""
    if not len(far.removed) and not len(far.moved):
        return checkpoint
    state, first = dict(checkpoint.model), 0
    for i in range(len(checkpoint.parts)):
        names = [name for name in state if name.startswith(f"parts.{i}.params.")]
        count = len(state[f"parts.{i}.params.means"])
        rows = slice(first, first + count)
        moved = (far.moved >= rows.start) & (far.moved < rows.stop)
        local = torch.from_numpy(far.moved[moved] - first)
        kept = torch.ones(count, dtype=torch.bool)
        kept[torch.from_numpy(far.removed[(far.removed >= rows.start) & (far.removed < rows.stop)] - first)] = False
        changed = {name: state[name].clone() for name in names}
        changed[f"parts.{i}.params.means"][local] = torch.from_numpy(far.means[moved])
        changed[f"parts.{i}.params.scales"][local] += torch.from_numpy(np.log(far.shrink[moved]))[:, None]
        state |= {name: values[kept] for name, values in changed.items()}
        first += count
    return replace(checkpoint, model=state)


def read_far(path: str | Path) -> FarGaussians:
    """Reads far.npz. Raises ResultError, naming the file and the rule that makes it, where it is not one."""
    return read_typed_arrays(path, RULE, FarGaussians, "far Gaussians")


def _largest_change(model: SplatModel, far: FarGaussians, views: Sequence[View]) -> float:
    """The largest change of a pixel of the views by `far`, in [0, 1]."""
    largest = 0.0
    for view in views:
        shown = model.gaussians_in(view)
        means, scales = shown.means.clone(), shown.scales.clone()
        moved = torch.from_numpy(far.moved).to(means.device)
        means[moved] = torch.from_numpy(far.means).to(means)
        scales[moved] *= torch.from_numpy(far.shrink).to(scales)[:, None]
        kept = torch.ones(len(shown), dtype=torch.bool, device=means.device)
        kept[torch.from_numpy(far.removed).to(means.device)] = False
        before = model.render(view, gaussians=shown).image.clamp(0.0, 1.0)
        changed = replace(shown, means=means, scales=scales)[kept]
        after = model.render(view, gaussians=changed).image.clamp(0.0, 1.0)
        largest = max(largest, float((after - before).abs().max()))
    return largest


def _visibility(
    model: SplatModel, rows: Int[Tensor, " f"], views: Sequence[View]
) -> tuple[Float[Tensor, " f"], Float[Tensor, "f 3"]]:
    """The largest contribution (opacity times transmittance, summed over pixels) of each of these rows to a view; and
    the mean position of the views' cameras, weighted by it."""
    largest, total = rows.new_zeros(len(rows), dtype=torch.float64), rows.new_zeros(len(rows), 1, dtype=torch.float64)
    weighted = rows.new_zeros(len(rows), 3, dtype=torch.float64)
    for view in views:
        shown = model.gaussians_in(view)
        # a Gaussian's weight in the compositing is the gradient of the image by its value
        values = shown.means.new_zeros(len(shown), 1).requires_grad_()
        with torch.enable_grad():
            (gradient,) = torch.autograd.grad(model.composited(shown, values, view).image.sum(), values)
        contributions = gradient[rows, 0].double()
        largest = torch.maximum(largest, contributions)
        total += contributions[:, None]
        weighted += contributions[:, None] * view.camera_to_world[:3, 3]
    return largest, weighted / total.clamp_min(1e-30)


def _nearer(
    means: Float[Tensor, "m 3"], centers: Float[Tensor, "m 3"], reach: float
) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, " m"]]:
    """Positions on the lines from `centers` to `means`, in the outermost part of the ball of radius `reach` and in
    their order, and the ratios of the distances from the centre."""
    offsets = means.double() - centers
    distances = offsets.norm(dim=1)
    directions = offsets / distances[:, None]
    along = (centers * directions).sum(dim=1)
    ends = (INSIDE * reach) ** 2 - centers.square().sum(dim=1)
    surface = (along.square() + ends).sqrt() - along
    moved = surface * (SHELL + (1.0 - SHELL) * (1.0 - surface / distances))
    return _array((centers + moved[:, None] * directions).float()), _array((moved / distances).float())


def _changes(removed: Int[Tensor, " r"], provenance: Provenance, views: int = 0) -> FarGaussians:
    """Changes that only remove rows."""
    nothing = np.zeros(0, dtype=np.float32)
    return FarGaussians(
        _array(removed), np.zeros(0, dtype=np.int64), nothing.reshape(0, 3), nothing, 0.0, views, provenance
    )


def _array(values: Tensor) -> np.ndarray:
    return values.cpu().numpy()
