"""The annotated objects that renderings of a drive show: by Gaussians of their own, or with the background."""

from collections.abc import Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from drivesplat.editing.placed_model import PlacedModel, placed_models
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.fixed_model import FixedModel
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.regions import fill, hull_of
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Scene, Track
from drivesplat.scene.tracks import Box
from drivesplat.trajectories.edited_actors import EditedActor

OWN, NONE = "own", "none"
"""What shows an object besides the names of parts: Gaussians of its own, or nothing."""
MIN_TRAVEL, MAX_TRAVEL_SHARE = 0.8, 0.25
"""A background smears an object that travels farther than both of these, metres and a share of its length. Boxes of
objects that stand jitter by 0.8 m in nuScenes."""
MIN_SEEN = 0.05
"""Share of the pixels of a box from which an image shows its object."""
MARGIN, FLOOR_SHARE = 0.1, 0.1
"""Metres by which a box is enlarged at its sides and roof for the Gaussians of the background that show its object, and
share of its height by which its floor is raised above those of the road."""


@dataclass(frozen=True)
class SeenObject:
    """An object in an image: the projected box, clipped to the image, as left, top, right, bottom in continuous pixels;
    and the share of the object, also of what lies outside the image, that is `visible` in it."""

    id: str
    corners: tuple[float, float, float, float]
    visible: float


@dataclass(frozen=True)
class ShownObjects:
    """The objects of a drive: the `actors` of a model as they now are, and `others`, annotated objects of which it has
    no Gaussians. `parts` are the parts of the model that may show each of the others."""

    model: SplatModel
    actors: Sequence[EditedActor]
    others: Sequence[EditedActor]
    parts: Sequence[frozenset[str]]

    @classmethod
    def of_scene(
        cls, scene: Scene, model: SplatModel, actors: Sequence[EditedActor], others: Sequence[EditedActor]
    ) -> "ShownObjects":
        """The objects of a scene; `others` are tracks of it."""
        tracks = {track.id: track for track in scene.tracks}
        return cls(model, actors, others, [parts_that_may_show(tracks[item.id], model) for item in others])

    def shown_by(self, seen: Collection[str]) -> dict[str, str]:
        """What shows each object, by its id: OWN, the name of a part, or NONE. `seen` are the ids of those that images
        show."""
        names = {actor.id: OWN for actor in self.actors}
        for item, parts in zip(self.others, self.parts, strict=True):
            names[item.id] = min(parts) if parts and item.id in seen else NONE
        return names

    def seen_in_any(self, views: Iterable[View]) -> set[str]:
        """The ids of the others that any of the views shows."""
        seen: set[str] = set()
        fixed = FixedModel(self.model)
        for view in views:
            (placed,) = placed_models(fixed, self.actors, np.array([view.time]))
            rest = self._chosen(item.id not in seen for item in self.others)
            seen |= {found.id for found in rest.others_in(view, placed)}
        return seen

    @torch.no_grad()
    def seen_in(self, view: View) -> list[SeenObject]:
        """The objects that a view shows."""
        now = np.array([view.time])
        (placed,) = placed_models(self.model, self.actors, now)
        boxes = [box_of(actor, view.time) for actor in self.actors if actor.present(now)[0]]
        found = (item for item in seen_objects(placed, boxes, view) if item is not None)
        return [*found, *self.others_in(view, placed)]

    @torch.no_grad()
    def others_in(self, view: View, placed: PlacedModel) -> list[SeenObject]:
        """Those of the others that a view shows. Gaussians are sampled only if a box is in the image."""
        now = np.array([view.time])
        in_image = self._chosen(
            bool(parts) and bool(item.present(now)[0]) and _outline(box_of(item, view.time), view) is not None
            for item, parts in zip(self.others, self.parts, strict=True)
        )
        if not in_image.others:
            return []
        found = (
            _seen_object(self.model, placed.gaussians_in(view), rows, box_of(item, view.time), view)
            for item, rows in in_image.rows_of_others(view, placed)
        )
        return [item for item in found if item is not None]

    def _chosen(self, chosen: Iterable[bool]) -> "ShownObjects":
        """The same with the `chosen` ones of the others alone."""
        pairs = [pair for pair, kept in zip(zip(self.others, self.parts, strict=True), chosen, strict=True) if kept]
        return replace(self, others=[item for item, _ in pairs], parts=[parts for _, parts in pairs])

    def rows_of_others(self, view: View, placed: PlacedModel) -> Iterator[tuple[EditedActor, Bool[Tensor, " n"]]]:
        """Those of the others that are present at the time of a view and may be shown, each with the Gaussians that
        show it: of the parts that may show it those whose centres lie in its box."""
        now, sets = np.array([view.time]), placed.sets_in(view)
        means, names = placed.gaussians_in(view).means, [part.name for part in placed.model.parts]
        part_of_row = torch.cat([torch.full((len(own),), i, device=means.device) for i, own in enumerate(sets)])
        for item, parts in zip(self.others, self.parts, strict=True):
            if not parts or not item.present(now)[0]:
                continue
            to_object, half = torch.from_numpy(inverse(item.poses(now)[0])).to(means), item.size / 2
            local = means @ to_object[:3, :3].T + to_object[:3, 3]
            floor = [MARGIN, MARGIN, -FLOOR_SHARE * item.size[2]]
            low, high = (torch.from_numpy(corner).to(means) for corner in (-half - floor, half + MARGIN))
            of_parts = torch.tensor([name in parts for name in names], device=means.device)[part_of_row]
            yield item, ((local > low) & (local < high)).all(dim=1) & of_parts


def parts_that_may_show(track: Track, model: SplatModel) -> frozenset[str]:
    """The parts of a model that may show an object of which it has no Gaussians: static ones where it stands, and those
    that move without objects where it travels."""
    places = track.object_to_world[:, :2, 3]
    farthest = float(np.linalg.norm(np.ptp(places, axis=0)))
    travels = farthest > max(MIN_TRAVEL, MAX_TRAVEL_SHARE * float(track.size[0]))
    return frozenset(part.name for part in model.parts if not part.has_objects and part.moves == travels)


def box_of(item: EditedActor, time: float) -> Box:
    """The box of an object of a drive at a time in film seconds."""
    return Box(item.id, ObjectClass.VEHICLE, item.category, item.size, item.poses(np.array([time]))[0], 0.0, 0)


def seen_objects(placed: PlacedModel, boxes: Sequence[Box], view: View) -> list[SeenObject | None]:
    """The object of each placement in a view, by its box; None where the image does not show it."""
    gaussians = placed.gaussians_in(view)
    return [_seen_object(placed.model, gaussians, gaussians.placement == i, box, view) for i, box in enumerate(boxes)]


def _seen_object(
    model: SplatModel, gaussians: Gaussians, rows: Bool[Tensor, " n"], box: Box, view: View
) -> SeenObject | None:
    """An object in a view that the `rows` of the Gaussians show; None where the image does not show it."""
    found = _outline(box, view)
    if found is None or not bool(rows.any()):
        return None
    polygon, pixels = found
    size = np.array([view.width, view.height])
    low, high = polygon.min(axis=0), polygon.max(axis=0)
    corners = np.concatenate([low.clip(0, size), high.clip(0, size)])
    inside = _cropped(view, corners[:2], corners[2:])
    whole = _cropped(view, low.clip(-size, 2 * size), high.clip(-size, 2 * size))
    share = model.composited(gaussians, rows.to(gaussians.means)[:, None], inside).image.sum()
    if share < MIN_SEEN * pixels:
        return None
    own = gaussians[rows]
    alone = model.composited(own, own.means.new_ones(len(own), 1), whole).alpha.sum()
    return SeenObject(box.track_id, tuple(corners.tolist()), min(1.0, float(share / alone)))


def _outline(box: Box, view: View) -> tuple[np.ndarray, int] | None:
    """The outline (n, 2) of a box in a view, in continuous pixels, and the number of pixels in it; None without any."""
    polygon = hull_of(box, view.viewmat.cpu().double().numpy(), view.K.cpu().double().numpy())
    pixels = 0 if polygon is None else int(fill(polygon, (view.width, view.height)).sum())
    return (polygon, pixels) if pixels else None


def _cropped(view: View, low: np.ndarray, high: np.ndarray) -> View:
    """The part of a view between two corners, which may lie outside of its image."""
    left, top = np.floor(low).astype(int).tolist()
    right, bottom = np.ceil(high).astype(int).tolist()
    return view.cropped(left, top, max(1, right - left), max(1, bottom - top))
