"""A model of a scene: a list of parts, a sky, and the properties of cameras; and its rendering."""

from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import Any

import torch
from jaxtyping import Bool, Float, Int, Int16
from torch import Tensor, nn

from drivesplat.errors import ResultError
from drivesplat.model.exposure import Exposures
from drivesplat.model.gaussians import Gaussians, GaussianSets, concatenate
from drivesplat.model.groups import strongest_group
from drivesplat.model.part import Part, RigidGroup, Sky
from drivesplat.model.picture import Picture
from drivesplat.model.scans import ScanPicture, ScanView, scan_picture
from drivesplat.model.states import IMAGE, SCAN, ModelStates, Want, want_of
from drivesplat.model.view import View, depth_at_lines, limited_scales, where_seen
from drivesplat.model.view_colors import projected_sets, rasterizer_colors
from drivesplat.rasterization.rasterization import Rendering, rasterize, rasterize_projected


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

    def precompute(self, times: Sequence[float], want: Want = IMAGE) -> None:
        """Precomputes the states of times: see `Part.precompute`."""
        for part in self.parts:
            part.precompute(times, want)

    def states(self, time: float, want: Want = IMAGE) -> ModelStates:
        """The state of each part at a time (seconds since the first image): see `Part.state`."""
        return tuple(part.state(time, want) for part in self.parts)

    def sample(self, states: ModelStates, want: Want = IMAGE) -> list[Gaussians]:
        """The set of Gaussians of each part in world coordinates, with what is wanted: see `Part.sample`. The states
        were looked up for the same `want`."""
        return [part.sample(state, want) for part, state in zip(self.parts, states, strict=True)]

    def at(self, time: float, want: Want = IMAGE) -> Gaussians:
        """All parts' Gaussians at a time as one set, in the parts' order."""
        return concatenate(self.sample(self.states(time, want), want))

    def gaussians_in(self, view: View) -> Gaussians:
        """The Gaussians that `render` shows in a view, as one set."""
        return self.at(view.time, want_of(self.seen_from(view)))

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

    def of_track(self, track_id: str) -> Bool[Tensor, " n"] | None:
        """The mask of a track's rows of `at`; None where no part knows the track as an object."""
        found = [part.of_track(track_id) for part in self.parts]
        if all(rows is None for rows in found):
            return None
        device = self.parts[0].params["means"].device
        nothing = (torch.zeros(part.row_count, dtype=torch.bool, device=device) for part in self.parts)
        return torch.cat([none if rows is None else rows for rows, none in zip(found, nothing, strict=True)])

    @property
    def rows(self) -> list[slice]:
        """The slice of rows of `at` of each part."""
        ends = [*accumulate(part.row_count for part in self.parts)]
        return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]

    def moving(self) -> Bool[Tensor, " n"]:
        """The mask of rows of `at` that belong to dynamic parts."""
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
    ) -> Picture:
        """Renders a view with spherical harmonics up to `sh_degree` (None: all).

        `gaussians`, a set or several, replace those of `gaussians_in`. Of a picture with other sets than one of each
        part, `objects_alpha` cannot be computed. `with_objects` computes it, too, where this needs no second rendering.
        """
        seen_from = self.seen_from(view)
        if gaussians is None:
            want = want_of(seen_from)
            gaussians = self.sample(self.states(view.time, want), want)
        sets = _sets(gaussians)
        plain = not (with_surface_depth or self.antialiased or self.max_scale)
        projected = projected_sets(sets, seen_from, sh_degree, with_depth) if plain else None
        objects = _rows_of_objects(self) if with_objects else None
        if projected is not None:
            size = seen_from.width, seen_from.height
            rendering = rasterize_projected(projected, *size, with_depth=with_depth, objects=objects)
        else:
            colors, degree = rasterizer_colors(sets, seen_from, sh_degree)
            rendering = rasterize(
                **_placed(sets.shapes, seen_from, self), colors=colors, sh_degree=degree, with_depth=with_depth,
                with_surface_depth=with_surface_depth, objects=objects,
            )  # fmt: skip
        splats, alpha = rendering.image.squeeze(0), rendering.alpha.squeeze(0)  # an index would copy in its gradient
        image = splats
        if self.sky is not None:
            image = self.sky.behind(splats, alpha, seen_from)
        if self.exposure is not None:
            image = self.exposure.applied(image, view)
        depth = None if rendering.depth is None else depth_at_lines(rendering.depth.squeeze((0, 3)), seen_from)
        alone = None if rendering.objects_alpha is None else rendering.objects_alpha.squeeze((0, 3))
        surfaces = rendering.surface_depth
        surfaces = None if surfaces is None else depth_at_lines(surfaces.squeeze(0), seen_from)
        return Picture(sets, image, splats, alpha.squeeze(2), depth, rendering.info, alone, surfaces)

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
            gaussians = self.sample(self.states(view.time, SCAN), SCAN)
        return scan_picture(_sets(gaussians), view, before)

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

    def composited(self, gaussians: Gaussians, values: Float[Tensor, "n v"], view: View) -> Rendering:
        """A rendering of `values` of Gaussians in place of their colours, without sky and exposure."""
        return rasterize(**_placed(gaussians, self.seen_from(view), self), colors=values)

    def strongest(self, gaussians: Gaussians, groups: Int[Tensor, " n"] | None, view: View) -> Int16[Tensor, "h w"]:
        """The one of `groups`, numbers from -1 of n Gaussians, that contributes most to each pixel; -1 where the sky
        does, where nothing is met, and everywhere without groups."""
        if groups is None:
            return torch.full((view.height, view.width), -1, dtype=torch.int16, device=gaussians.means.device)

        def composited(shares: Tensor) -> Tensor:
            return self.composited(gaussians, shares.to(gaussians.means), view).image.squeeze(0)

        sky = 1.0 - self.composited(gaussians, gaussians.means.new_ones(len(gaussians), 1), view).alpha
        return strongest_group(groups, composited, sky.squeeze((0, 3))).to(torch.int16)


def _sets(gaussians: Gaussians | Sequence[Gaussians]) -> GaussianSets:
    return GaussianSets([gaussians] if isinstance(gaussians, Gaussians) else gaussians)


def _rows_of_objects(model: SplatModel) -> slice | None:
    """The rows of the parts with objects; None without any, or where rows of other parts lie between them."""
    of_parts = zip(model.parts, model.rows, strict=True)
    rows = [own for part, own in of_parts if part.has_objects and own.stop > own.start]
    together = all(before.stop == after.start for before, after in pairwise(rows))
    return slice(rows[0].start, rows[-1].stop) if rows and together else None


def _placed(gaussians: Gaussians, seen_from: View, model: SplatModel) -> dict[str, Any]:
    """The arguments of the rasterizer for Gaussians in a view, without their colours."""
    shown = where_seen(gaussians, seen_from)
    scales = limited_scales(shown, seen_from, model.max_scale) if model.max_scale else shown.scales
    camera = {"viewmats": seen_from.viewmat[None], "Ks": seen_from.K[None]}
    size = {"width": seen_from.width, "height": seen_from.height}
    shapes = {"means": shown.means, "quats": gaussians.quats, "scales": scales, "opacities": gaussians.opacities}
    return {**shapes, **camera, **size, "antialiased": model.antialiased}
