"""A model at one time with its objects in their places, as cameras and LiDARs see it. Films, edits, rendered drives and
scans, and the Python interface show this."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int16
from torch import Tensor

from drivesplat.editing.shading import shaded
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.scans import ScanPicture, ScanView, group_met
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN, ActorPlacement, Want, want_of
from drivesplat.model.view import View
from drivesplat.rendering.fixed_model import FixedModel, RenderedImage
from drivesplat.trajectories.edited_actors import EditedActor
from drivesplat.trajectories.motion import HALF_STEP


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
