"""The Gaussians of a drive at a time with its objects placed, and what cameras and LiDARs see of them."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import torch
from jaxtyping import Int16
from torch import Tensor

from drivesplat.drive.cameras import PlacedCamera
from drivesplat.drive.drive_scan import DriveScan
from drivesplat.drive.drive_view import DriveView, ObjectBox
from drivesplat.drive.lenses import resampled
from drivesplat.drive.world_actor import WorldActor
from drivesplat.editing.shown_objects import ShownObjects, box_of, seen_object
from drivesplat.errors import RequestError
from drivesplat.model.gaussians import Gaussians, concatenate
from drivesplat.model.scans import group_met, view_of_scan
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN, Want, want_of
from drivesplat.model.view import View
from drivesplat.rendering.labels import objects_in_view, strongest_in_view
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.scene.tracks import Box

SKY = "sky"
"""The class of what no Gaussian shows."""
MAX_PIXELS = 16_777_216
"""Pixels that are rendered at once; larger images are rendered in bands of lines."""
INTERPOLATED = ("rgb", "alpha")
"""The outputs of a distorted camera that are interpolated between pixels."""


@dataclass(frozen=True, eq=False)
class SampledWorld:
    """A drive at a `time`: the `actors` of the model with their places, the objects that it shows in its `static` part,
    and the class of each track. `as_recorded`: no object was moved, added or removed."""

    model: SplatModel
    time: float
    actors: tuple[WorldActor, ...]
    static: ShownObjects
    class_of: Mapping[str, ObjectClass]
    as_recorded: bool
    _samples: dict[tuple[Want, bool], tuple[Sequence[Gaussians], Gaussians]] = field(default_factory=dict, repr=False)

    @property
    def device(self) -> torch.device:
        """The device of the model."""
        return self.model.parts[0].params["means"].device

    @cached_property
    def classes(self) -> tuple[str, ...]:
        """The names of classes: the sky, the parts without objects, and the classes of objects."""
        known = {self.class_of[item.source].value for item in (*self.actors, *self.static.others)}
        return (SKY, *(part.name for part in self.model.parts if not part.has_objects), *sorted(known))

    def image(self, placed: PlacedCamera, outputs: Collection[str]) -> DriveView:
        """What a camera sees."""
        camera, view = placed.camera, placed.view(self.device)
        if camera.distorted:
            if "boxes" in outputs:
                raise RequestError("boxes are those of a pinhole camera: leave them out for a distorted one")
            faces = camera.faces
            shown = [self._tensors(face.view(view), outputs) for face in faces]
            found = {
                name: resampled(faces, [own[name] for own in shown], name not in INTERPOLATED, name == "depth")
                for name in shown[0]
            }
            seen = torch.stack([face.shows for face in faces]).any(dim=0).to(self.device)
        else:
            rows = max(1, MAX_PIXELS // view.width)
            bands = [(top, min(rows, view.height - top)) for top in range(0, view.height, rows)]
            if len(bands) == 1:
                found = self._tensors(view, outputs)
            else:
                parts = [self._tensors(view.cropped(0, top, view.width, height), outputs) for top, height in bands]
                found = {name: torch.cat([own[name] for own in parts]) for name in parts[0]}
            seen = torch.ones(view.height, view.width, dtype=torch.bool, device=self.device)
        if "valid" in outputs:
            found["valid"] = seen & torch.from_numpy(camera.uncovered()).to(self.device)
        boxes = tuple(self._boxes(view)) if "boxes" in outputs else None
        return DriveView(self._ids, **found, boxes=boxes, classes=self.classes if "semantic" in outputs else ())

    def scan(self, sensor: RecordedScan, beam_spread: tuple[float, float]) -> DriveScan:
        """What the rays of a scan return. `beam_spread` in radians."""
        view = view_of_scan(sensor, beam_spread, self.device)
        _, gaussians = self._sampled(SCAN, placed=True)
        picture = self.model.scan(view, gaussians=gaussians)
        unblocked = torch.from_numpy(~sensor.blocked).to(self.device)
        returned = (picture.returned > 0.5) & (picture.range > 0.0) & unblocked
        met = torch.full(sensor.blocked.shape, -1, dtype=torch.int16, device=self.device)
        if gaussians.placement is not None:
            met = group_met(gaussians, view, gaussians.placement).to(torch.int16)
        return DriveScan(
            self._ids, sensor, picture.range, picture.returned, returned, picture.intensity,
            torch.where(picture.range > 0.0, met, -1),
        )  # fmt: skip

    @property
    def _ids(self) -> tuple[str, ...]:
        return tuple(actor.id for actor in self.actors)

    def _sampled(self, want: Want, placed: bool) -> tuple[Sequence[Gaussians], Gaussians]:
        """The Gaussians of each part, and all as one set; with the objects `placed`, or as recorded. They are kept for
        the next camera."""
        if (want, placed) not in self._samples:
            placements = tuple(actor.placement for actor in self.actors) if placed else None
            wanted = replace(want, placements=placements)
            sets = self.model.sample(self.model.states(self.time, wanted), wanted)
            self._samples[want, placed] = sets, concatenate(sets)
        return self._samples[want, placed]

    def _placed(self, view: View) -> tuple[Sequence[Gaussians], Gaussians]:
        """The Gaussians that a view shows, with the numbers of their objects."""
        return self._sampled(want_of(self.model.seen_from(view)), placed=True)

    def _tensors(self, view: View, outputs: Collection[str]) -> dict[str, Tensor]:
        found: dict[str, Tensor] = {}
        sets, whole = self._sampled(want_of(self.model.seen_from(view)), placed=not self.as_recorded)
        gaussians = sets if self.as_recorded else whole  # as films and edits render them
        if "rgb" in outputs or "alpha" in outputs:
            picture = self.model.render(view, gaussians=gaussians)
            found |= {name: getattr(picture, of) for name, of in (("rgb", "image"), ("alpha", "alpha"))}
        if "depth" in outputs:
            depth = self.model.render(view, gaussians=gaussians, with_surface_depth=True).surface_depth
            assert depth is not None
            found["depth"] = depth
        if "instance" in outputs:
            found["instance"] = objects_in_view(self.model, self._placed(view)[1], view)
        if "semantic" in outputs:
            found["semantic"] = self._classes(view)
        return {name: values for name, values in found.items() if name in outputs}

    def _classes(self, view: View) -> Int16[Tensor, "h w"]:
        sets, gaussians = self._placed(view)
        number = {name: i for i, name in enumerate(self.classes)}
        rows = torch.cat(
            [
                torch.full((len(own),), number.get(part.name, -1), dtype=torch.int16, device=self.device)
                for part, own in zip(self.model.parts, sets, strict=True)
            ]
        )
        if gaussians.placement is not None:
            of_actors = [number[self.class_of[actor.source].value] for actor in self.actors]
            own = torch.tensor([*of_actors, -1], dtype=torch.int16, device=self.device)[gaussians.placement]
            rows = torch.where(gaussians.placement >= 0, own, rows)
        for item, shown in self.static.rows_of_others(self.time, sets, gaussians):
            rows[shown] = number[self.class_of[item.source].value]
        return strongest_in_view(self.model, gaussians, rows, view).clamp(min=0)

    def _boxes(self, view: View) -> Iterator[ObjectBox]:
        sets, gaussians = self._placed(view)
        boxes = [Box(a.id, ObjectClass.VEHICLE, a.category, a.size, a.pose, 0.0, 0) for a in self.actors]
        seen = [seen_object(self.model, gaussians, i, box, view) for i, box in enumerate(boxes)]
        known = {item.id: item for item in self.static.others}
        others = self.static.others_in(view, sets, gaussians)
        boxes += [box_of(known[item.id], view.time) for item in others]
        for box, item in zip(boxes, [*seen, *others], strict=True):
            if item is not None:
                own = box.category, box.size.copy(), box.object_to_world
                yield ObjectBox(item.id, *own, item.corners, item.visible)
