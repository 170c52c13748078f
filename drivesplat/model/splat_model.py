"""A model of a scene: a list of parts, a sky, and the properties of cameras; and its rendering."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate, pairwise
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from drivesplat.errors import ResultError
from drivesplat.kernels.colored_projection import SetOnRoad
from drivesplat.kernels.road_distance import Road
from drivesplat.model.exposure import Exposures
from drivesplat.model.gaussians import Gaussians, GaussianSets, concatenate
from drivesplat.model.part import ActorPlacement, Part, RigidGroup, Shapes, Sky
from drivesplat.model.picture import Picture
from drivesplat.model.scans import ScanPicture, ScanView, scan_picture
from drivesplat.model.time_states import ScanTimeStates, TimeStates
from drivesplat.model.view import View, depth_at_lines, limited_scales, where_seen
from drivesplat.model.view_colors import projected_sets, rasterizer_colors
from drivesplat.rasterization import Rendering, rasterize, rasterize_projected


class SplatModel(nn.Module):
    """Parts, a sky (None: black) and exposures of cameras (None: all alike). Without `rolling_shutter`, views are
    rendered as if they had a global shutter. With `max_scale` above 0, Gaussians in images have `limited_scales`."""

    def __init__(
        self,
        parts: Sequence[Part],
        sky: Sky | None,
        antialiased: bool = False,
        exposure: Exposures | None = None,
        rolling_shutter: bool = True,
        max_scale: float = 0.0,
    ):
        super().__init__()
        self.parts = nn.ModuleList(parts)
        self.sky = sky
        self.exposure = exposure
        self.antialiased = antialiased
        self.rolling_shutter = rolling_shutter
        self.max_scale = max_scale

    def __len__(self) -> int:
        return sum(len(part) for part in self.parts)

    @property
    def beside_parts(self) -> dict[str, Sky | Exposures]:
        """Other learned modules by name, with `params` and `learning_rates()`."""
        named = {"sky": self.sky, "exposure": self.exposure}
        return {name: module for name, module in named.items() if module is not None}

    def precompute(self, times: Sequence[float]) -> None:
        """Precomputes state for the given times: see `Part.precompute`."""
        for part in self.parts:
            part.precompute(times)

    def gaussians_at(self, time: float, with_velocities: bool = False, with_echoes: bool = False) -> Gaussians:
        """All parts' Gaussians in world coordinates at a time (seconds since the first image), in the parts' order;
        `with_velocities` of those that move, which rolling shutters and LiDARs need, and `with_echoes` for LiDARs."""
        return concatenate(self.sets_at(time, with_velocities, with_echoes))

    def sets_at(self, time: float, with_velocities: bool = False, with_echoes: bool = False) -> list[Gaussians]:
        """As `gaussians_at`, the set of each part."""
        found = []
        for part in self.parts:
            velocities = part.velocities(time) if with_velocities else None
            shown = part.seen_by_lidar(part.at(time)) if with_echoes else part.at(time)
            found.append(replace(shown, velocities=velocities, echoes=part.echoes(time) if with_echoes else None))
        return found

    def time_states(self, time: float) -> TimeStates | None:
        """The time state of every part: see `Part.time_state`. None where one has none."""
        states = [part.time_state(time) for part in self.parts]
        return None if any(state is None for state in states) else states

    def sets_at_time_states(self, states: TimeStates) -> list[Gaussians]:
        """As `sets_at`, by the parts' time states."""
        return [part.at_time_state(state) for part, state in zip(self.parts, states, strict=True)]

    def scan_states(self, time: float) -> ScanTimeStates | None:
        """The time states that a scan at a time depends on; None where a part has none."""
        now, before, after = (self.time_states(at) for at in ScanTimeStates.times(time))
        return None if now is None or before is None or after is None else ScanTimeStates(now, before, after)

    def sets_at_scan_states(self, states: ScanTimeStates) -> list[Gaussians]:
        """As `sets_at` with velocities and echoes, but without colours, by the parts' time states."""
        return [
            replace(part.scanned_at_time_state(now), velocities=part.velocities_between(before, after))
            for part, now, before, after in zip(self.parts, *states, strict=True)
        ]

    def gaussians_with_placements(
        self,
        time: float,
        placements: Sequence[ActorPlacement],
        with_velocities: bool = False,
        with_echoes: bool = False,
    ) -> Gaussians:
        """As `gaussians_at`, with objects at `placements` and no others: see `Part.with_placements`."""
        found = []
        for part in self.parts:
            velocities = part.velocities_with_placements(time, placements) if with_velocities else None
            echoes = part.echoes_with_placements(time, placements) if with_echoes else None
            shown = part.with_placements(time, placements)
            shown = part.seen_by_lidar(shown) if with_echoes else shown
            found.append(replace(shown, velocities=velocities, echoes=echoes))
        return concatenate(found)

    def placement_of_rows(self, placements: Sequence[ActorPlacement]) -> Int[Tensor, " m"]:
        """The index of the placement of each row of `gaussians_with_placements`; -1 for none."""
        return torch.cat([part.placement_of_rows(placements) for part in self.parts])

    def rigid_groups(self, time: float) -> dict[str, RigidGroup]:
        """The rigid groups of all parts: see `Part.rigid_groups`. Raises ResultError where two have the same name."""
        found: dict[str, RigidGroup] = {}
        for part in self.parts:
            groups = part.rigid_groups(time)
            duplicates = found.keys() & groups.keys()
            if duplicates:
                raise ResultError(
                    f"the model has two rigid groups named {min(duplicates)!r}; give every part and track a unique "
                    "name and train it again"
                )
            found |= groups
        return found

    def shapes(self, track_id: str, times: Sequence[float]) -> Shapes | None:
        """The shapes of an object's Gaussians at `times`: see `Part.shapes`."""
        found = (part.shapes(track_id, times) for part in self.parts)
        return next((shapes for shapes in found if shapes is not None), None)

    def shape_weights(
        self, times: Sequence[float], placements: Sequence[ActorPlacement]
    ) -> Float[Tensor, "t k"] | None:
        """What the shape of an object depends on at `times`: see `Part.shape_weights`."""
        found = (part.shape_weights(times, placements) for part in self.parts)
        return next((weights for weights in found if weights is not None), None)

    def of_track(self, track_id: str) -> Bool[Tensor, " n"] | None:
        """The mask of a track's rows of `gaussians_at`; None where no part knows the track as an object."""
        found = [part.of_track(track_id) for part in self.parts]
        if all(rows is None for rows in found):
            return None
        device = self.parts[0].params["means"].device
        nothing = (torch.zeros(part.row_count, dtype=torch.bool, device=device) for part in self.parts)
        return torch.cat([none if rows is None else rows for rows, none in zip(found, nothing, strict=True)])

    @property
    def rows(self) -> list[slice]:
        """The slice of rows of `gaussians_at` of each part."""
        ends = [*accumulate(part.row_count for part in self.parts)]
        return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]

    def moving(self) -> Bool[Tensor, " n"]:
        """The mask of rows of `gaussians_at` that belong to dynamic parts."""
        device = self.parts[0].params["means"].device
        return torch.cat([torch.full((part.row_count,), part.moves, device=device) for part in self.parts])

    def render(
        self,
        view: View,
        sh_degree: int | None = None,
        *,
        gaussians: Gaussians | Sequence[Gaussians] | None = None,
        with_depth: bool = False,
        with_objects: bool = False,
        with_surface_depth: bool = False,
        road: Road | None = None,
    ) -> Picture:
        """Renders a view with spherical harmonics up to `sh_degree` (None: all).

        `gaussians`, a set or several, replace `sets_in(view)`. Of a picture with other sets than one of each part,
        neither `objects_alpha` nor the terms of static parts can be computed. `with_objects` computes the former, too,
        where this needs no second rendering. With a `road`, the picture has the distance of static Gaussians from it
        where the kernel of the projection computes it.
        """
        sets = _sets(self.sets_in(view) if gaussians is None else gaussians)
        seen_from = self.seen_from(view)
        plain = not (with_surface_depth or self.antialiased or self.max_scale)
        on_road = self._on_road(road, sets)
        projected = projected_sets(sets, seen_from, sh_degree, with_depth, on_road) if plain else None
        objects = self._rows_of_objects() if with_objects else None
        if projected is not None:
            size = seen_from.width, seen_from.height
            rendering = rasterize_projected(projected, *size, with_depth=with_depth, objects=objects)
        else:
            colors, degree = rasterizer_colors(sets, seen_from, sh_degree)
            rendering = rasterize(
                **self._placed(sets.shapes, seen_from), colors=colors, sh_degree=degree, with_depth=with_depth,
                with_surface_depth=with_surface_depth, objects=objects,
            )  # fmt: skip
        splats, alpha = rendering.image.squeeze(0), rendering.alpha.squeeze(0)  # an index would copy in its gradient
        image = splats
        if self.sky is not None:
            image = self.sky.behind(splats, alpha, seen_from)
        if self.exposure is not None:
            image = self.exposure.applied(image, view.camera)
        depth = None if rendering.depth is None else depth_at_lines(rendering.depth.squeeze((0, 3)), seen_from)
        alone = None if rendering.objects_alpha is None else rendering.objects_alpha.squeeze((0, 3))
        surfaces = rendering.surface_depth
        surfaces = None if surfaces is None else depth_at_lines(surfaces.squeeze(0), seen_from)
        picture = Picture(sets, image, splats, alpha.squeeze(2), depth, rendering.info, alone, surfaces)
        if projected is None:
            return picture
        means = projected.mean_opacity, projected.mean_scale
        return replace(picture, means_of_sets=means, road_distance=projected.road_distance)

    def scan(
        self,
        view: ScanView,
        *,
        gaussians: Gaussians | Sequence[Gaussians] | None = None,
        before: Float[Tensor, "b a"] | None = None,
    ) -> ScanPicture:
        """What a LiDAR measures in a revolution. `gaussians`, a set or several, replace the model's own; `before`: see
        `scan_picture`.

        Raises ResultError for a model that was trained without LiDAR.
        """
        if gaussians is None:
            gaussians = self.sets_at(view.time, with_velocities=True, with_echoes=True)
        return scan_picture(_sets(gaussians), view, before)

    def gaussians_in(self, view: View) -> Gaussians:
        """The Gaussians that `render` shows in a view."""
        return concatenate(self.sets_in(view))

    def sets_in(self, view: View) -> list[Gaussians]:
        """As `gaussians_in`, the set of each part."""
        return self.sets_at(view.time, with_velocities=self.rolling_shutter and view.shutter is not None)

    def seen_from(self, view: View) -> View:
        """The view, without rolling shutter where this model renders none."""
        return view if self.rolling_shutter else view.global_shutter

    def objects_alpha(self, picture: Picture, view: View) -> Float[Tensor, "h w"] | None:
        """The alpha of the parts with objects alone, for a picture with a set of each part; None without such parts.
        That of the picture where it has one; otherwise they are rendered."""
        if picture.objects_alpha is not None:
            return picture.objects_alpha
        objects = [own for part, own in zip(self.parts, picture.sets, strict=True) if part.has_objects]
        if not objects:
            return None
        alone = concatenate(objects)
        return self.composited(alone, alone.means.new_ones(len(alone), 1), view).alpha.squeeze((0, 3))

    def _on_road(self, road: Road | None, sets: GaussianSets) -> SetOnRoad | None:
        """The set of the static part, with a road. None without a road, where several parts are static, and where
        `sets` are not one of each part."""
        static = [index for index, part in enumerate(self.parts) if not part.moves]
        known = road is not None and len(static) == 1 and len(sets) == len(self.parts)
        return SetOnRoad(static[0], road) if known else None

    def _rows_of_objects(self) -> slice | None:
        """The rows of the parts with objects; None without any, or where rows of other parts lie between them."""
        of_parts = zip(self.parts, self.rows, strict=True)
        rows = [own for part, own in of_parts if part.has_objects and own.stop > own.start]
        together = all(before.stop == after.start for before, after in pairwise(rows))
        return slice(rows[0].start, rows[-1].stop) if rows and together else None

    def class_logits(self, picture: Picture, view: View) -> Float[Tensor, "h w c"] | None:
        """The rendered class logits of a picture of this model; None for a model without semantic classes."""
        if not all("classes" in part.params for part in self.parts):
            return None
        logits = torch.cat([part.params["classes"] for part in self.parts])
        return self.composited(picture.shapes, logits, view).image.squeeze(0)

    def composited(self, gaussians: Gaussians, values: Float[Tensor, "n v"], view: View) -> Rendering:
        """A rendering of `values` of Gaussians in place of their colours, without sky and exposure."""
        return rasterize(**self._placed(gaussians, self.seen_from(view)), colors=values)

    def _placed(self, gaussians: Gaussians, seen_from: View) -> dict[str, Any]:
        """The arguments of the rasterizer for Gaussians in a view, without their colours."""
        shown = where_seen(gaussians, seen_from)
        scales = limited_scales(shown, seen_from, self.max_scale) if self.max_scale else shown.scales
        camera = {"viewmats": seen_from.viewmat[None], "Ks": seen_from.K[None]}
        size = {"width": seen_from.width, "height": seen_from.height}
        shapes = {"means": shown.means, "quats": gaussians.quats, "scales": scales, "opacities": gaussians.opacities}
        return {**shapes, **camera, **size, "antialiased": self.antialiased}


def _sets(gaussians: Gaussians | Sequence[Gaussians]) -> GaussianSets:
    return GaussianSets([gaussians] if isinstance(gaussians, Gaussians) else gaussians)
