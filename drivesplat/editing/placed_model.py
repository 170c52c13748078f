"""A model at one time with its objects in their places, as cameras and LiDARs see it. Films, edits, rendered drives and
scans, and the Python interface show this.

Inserted objects cast shadows: the Gaussians of the static parts that lie on the ground beside and below a box lose a
share of their brightness. Depth, LiDAR and masks of objects stay as they are.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int16
from torch import Tensor

from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.scans import ScanPicture, ScanView, group_met
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN, ActorPlacement, Want, want_of
from drivesplat.model.view import View
from drivesplat.rendering.fixed_model import FixedModel, RenderedImage
from drivesplat.scene.light import RIM, Shade, contact_shadow, hides_sun
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import HALF_STEP

LAYER = 0.3
"""Metres above and below the floor of a box within which Gaussians lie on its ground."""
BELOW, INSET = 0.5, 0.15
"""The least share of brightness that ground below a box loses, farther than INSET metres from its rim."""
SPREAD = 0.7
"""Where a Gaussian is looked at beside its centre, in standard deviations along its two longest axes."""


@dataclass(frozen=True, eq=False)
class PlacedModel:
    """A model at a `time` in seconds since the first image. With `placements`, objects are at these and no others, and
    are known by their index in them; None: objects are as recorded, and are not told apart.

    Gaussians are sampled once for all cameras with a global shutter, once for those with a rolling one, and once for
    LiDARs.

    >>> placed = PlacedModel(FixedModel(model), 4.2, [ActorPlacement("bf53", object_to_world=pose)])
    >>> image, car = placed.render(view).image, placed.objects_in(view) == 0
    """

    fixed: FixedModel
    time: float
    placements: Sequence[ActorPlacement] | None = None
    _sets: dict[Want, Sequence[Gaussians]] = field(default_factory=dict, repr=False)
    _joined: dict[Want, Gaussians] = field(default_factory=dict, repr=False)

    @property
    def model(self) -> SplatModel:
        """The model, with objects as recorded."""
        return self.fixed.model

    def sets_in(self, view: View | ScanView) -> Sequence[Gaussians]:
        """The Gaussians that a view shows: a set of each part of the model."""
        want = self._wanted(view)
        if want not in self._sets:
            wanted = want if self.placements is None else replace(want, placements=tuple(self.placements))
            sets = self.fixed.sample(self.time, wanted)
            self._sets[want] = self._in_shadow(sets) if want.colors else sets
        return self._sets[want]

    def gaussians_in(self, view: View | ScanView) -> Gaussians:
        """The Gaussians that a view shows, as one set, in the order of the parts."""
        want = self._wanted(view)
        if want not in self._joined:
            self._joined[want] = concatenate(self.sets_in(view))
        return self._joined[want]

    def render(self, view: View, with_surface_depth: bool = False) -> RenderedImage:
        """What a camera sees."""
        return self.fixed.render(view, self.sets_in(view), with_surface_depth)

    def render_all(self, views: Sequence[View]) -> list[RenderedImage]:
        """What cameras see. A GPU is waited for once for all of them."""
        return self.fixed.render_all([(view, self.sets_in(view)) for view in views])

    def surface_depth(self, view: View) -> Float[Tensor, "h w"]:
        """The depth in metres along the camera's axis of the surfaces that an image shows; 0 where there are none."""
        depth = self.render(view, with_surface_depth=True).surface_depth
        assert depth is not None
        return depth

    def objects_in(self, view: View) -> Int16[Tensor, "h w"]:
        """The index of the placement that contributes most to each pixel; -1 for what is no object, and for sky."""
        gaussians = self.gaussians_in(view)
        return self.model.strongest(gaussians, gaussians.placement, view)

    def scan(self, view: ScanView) -> ScanPicture:
        """What a LiDAR measures. Raises ResultError for a model that was trained without LiDAR."""
        return self.fixed.scan(view, self.sets_in(view))

    def objects_met(self, view: ScanView) -> Int16[Tensor, "b a"]:
        """The index of the placement that each ray meets; -1 where it meets no object."""
        gaussians = self.gaussians_in(view)
        if gaussians.placement is None:
            return torch.full(view.rays.azimuths.shape, -1, dtype=torch.int16, device=gaussians.means.device)
        return group_met(gaussians, view, gaussians.placement).to(torch.int16)

    def _in_shadow(self, sets: Sequence[Gaussians]) -> Sequence[Gaussians]:
        """The sets of the parts, those of static ones in the shadows of inserted objects."""
        shades = [(p.object_to_world, p.shade) for p in self.placements or () if p.shade is not None]
        known = [(pose, shade) for pose, shade in shades if pose is not None]
        if not known:
            return sets
        pairs = zip(self.model.parts, sets, strict=True)
        return [own if part.has_objects or part.moves else shaded(own, known) for part, own in pairs]

    def _wanted(self, view: View | ScanView) -> Want:
        return SCAN if isinstance(view, ScanView) else want_of(self.model.seen_from(view))


def actor_placements(actors: Sequence[EditedActor], seconds: np.ndarray) -> list[list[ActorPlacement]]:
    """The actors present at each of `seconds` (n,), with their poses and distances then and HALF_STEP before and
    after."""
    result: list[list[ActorPlacement]] = [[] for _ in seconds]
    for actor in actors:
        own = ActorPlacement(actor.source, None, actor.scale, actor.color_matrix, phase=actor.phase, shade=actor.shade)
        times = [seconds + step for step in (0.0, -HALF_STEP, HALF_STEP)] if actor.edited else []
        poses, walked = [actor.poses(at) for at in times], [actor.walked(at) for at in times]
        for number in np.flatnonzero(actor.present(seconds)):
            placement = own
            if times:
                pose, *around = (of_time[number] for of_time in poses)
                distance, *beside = (float(of_time[number]) for of_time in walked)
                placement = replace(
                    own, object_to_world=pose, around=tuple(around), walked=distance, walked_around=tuple(beside)
                )
            result[number].append(placement)
    return result


def placed_models(
    model: SplatModel | FixedModel, actors: Sequence[EditedActor], seconds: np.ndarray
) -> Iterator[PlacedModel]:
    """The model at each of `seconds` (n,) with the actors that are then present. The index of an object is that among
    those present, in the order of `actors`."""
    fixed = model if isinstance(model, FixedModel) else FixedModel(model)
    for time, placements in zip(seconds.tolist(), actor_placements(actors, seconds), strict=True):
        yield PlacedModel(fixed, time, placements)


def shaded(gaussians: Gaussians, shades: Sequence[tuple[np.ndarray, Shade]]) -> Gaussians:
    """Static Gaussians in the shadows of boxes, each with its pose (4, 4) in the world."""
    kept = torch.ones_like(gaussians.opacities)
    for pose, shade in shades:
        rows = _near(gaussians.means, pose, shade)
        if len(rows):
            kept[rows] *= torch.from_numpy(1.0 - _lost(gaussians[rows], pose, shade)).to(kept)
    if not bool((kept < 1.0).any()):
        return gaussians
    share = kept[:, None, None]
    sh0 = share * gaussians.sh0 + (share - 1.0) * (0.5 / SH_C0)  # a colour is 0.5 plus its harmonics
    return replace(gaussians, sh0=sh0, shN=share * gaussians.shN)


def _near(means: Tensor, pose: np.ndarray, shade: Shade) -> Tensor:
    """The indices (n,) of Gaussians on the ground that the shadow of a box may reach."""
    size, sun = shade.size, shade.light.sun
    reach = 3.0 * RIM * size[2] if sun is None else max(3.0 * RIM, 1.0 / np.tan(np.arcsin(sun[2]))) * size[2]
    to_box = torch.from_numpy(np.linalg.inv(pose)).to(means)
    local = means @ to_box[:3, :3].T + to_box[:3, 3]
    half = torch.from_numpy(np.asarray(size) / 2.0).to(means)
    on_ground = (local[:, 2] + half[2]).abs() < LAYER
    return (on_ground & (local[:, :2].abs() < half[:2] + reach).all(dim=1)).nonzero()[:, 0]


def _lost(gaussians: Gaussians, pose: np.ndarray, shade: Shade) -> np.ndarray:
    """The share (n,) of brightness that Gaussians lose."""
    means = gaussians.means.double().cpu().numpy()
    count, rotation = len(means), pose[:3, :3]
    sizes = np.tile(np.asarray(shade.size, dtype=np.float64), (count, 1))
    local = (means - pose[:3, 3]) @ rotation
    local[:, 2] = -sizes[:, 2] / 2.0  # seen on the ground, wherever the centre is
    lost = shade.light.contact * contact_shadow(local, sizes)
    below = (np.abs(local[:, :2]) < sizes[:, :2] / 2.0 - INSET).all(axis=1)
    lost = np.where(below, np.maximum(lost, BELOW), lost)
    if shade.light.sun is None:
        return lost
    axes = (rotation_matrix(gaussians.quats) * gaussians.scales[:, None]).double().cpu().numpy()
    order = np.argsort(-np.linalg.norm(axes, axis=1), axis=1)[:, :2]
    longest = np.take_along_axis(axes, order[:, None], axis=2)  # (n, 3, 2)
    sun = np.tile(shade.light.sun @ rotation, (count, 1))
    hidden = np.zeros(count)
    steps = [(0.0, 0.0), (SPREAD, 0.0), (-SPREAD, 0.0), (0.0, SPREAD), (0.0, -SPREAD)]
    for step in steps:
        offset = (longest @ np.array(step)) @ rotation
        offset[:, 2] = 0.0
        hidden += hides_sun(local + offset, sizes, sun) / len(steps)
    return 1.0 - (1.0 - lost) * (1.0 - shade.light.cast * hidden)
