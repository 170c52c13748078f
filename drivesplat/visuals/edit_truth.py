"""The stage `edit_truth`: an edited drive against the truth of a synthetic world, in which the edit truly happened.

It measures inserted objects: the errors of their pixels, of their shadows and of the rest of the image, by the
direction from which they are shown, beside those of the same drive without them.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from scipy.ndimage import binary_dilation, binary_opening

from drivesplat.editing.actors import EditedModel, edited_model
from drivesplat.editing.assets.asset import Inserts
from drivesplat.editing.placed_model import PlacedModel, placed_models
from drivesplat.errors import DatasetError
from drivesplat.evaluation.metrics import RegionMetrics, depth_summary, relative_depth_errors
from drivesplat.evaluation.scan_metrics import ScanPool
from drivesplat.evaluation.scan_truth import ScanTruth
from drivesplat.evaluation.synthetic import DriveTruth
from drivesplat.machine.device import explain_out_of_memory
from drivesplat.model.checkpoint import TrainedCheckpoint, open_model
from drivesplat.model.scans import view_of_scan
from drivesplat.model.view import View
from drivesplat.readers.truth import TruthFrame
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scan_record import ScanRecords
from drivesplat.scene.scene import Frame
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.render import EditJob
from drivesplat.trajectories.edited_actors import EditedActor

SHADOW_STEP = 0.06
"""The change of a true image, of colours in [0, 1], from which a pixel beside the inserted objects is in their shadow
or their reflection."""
BORDER = 2
"""Pixels around an object that count neither as its shadow nor as outside: its true edge mixes both."""
ANGLES = {"0-30": (0.0, 30.0), "30-90": (30.0, 90.0), "90-180": (90.0, 181.0)}
"""Degrees between the direction from which an object is shown and the nearest one from which its asset was seen."""
CHANGED = 2.0 / 255.0
"""The change of a colour from which a pixel outside of objects and shadows counts as changed."""
SHOWN = 4
"""Rows of the picture."""


@dataclass(frozen=True)
class EditFrame:
    """An image of an edited drive: the true one and that before the edit (h, w, 3) in [0, 1], the rendering with and
    without the inserted objects, and by their ids the true pixels of these objects (h, w) bool, the rendered ones, and
    the angles in degrees between shown and seen directions."""

    truth: np.ndarray
    before: np.ndarray
    rendered: np.ndarray
    without: np.ndarray
    objects: Mapping[str, np.ndarray]
    shown: Mapping[str, np.ndarray]
    angles: Mapping[str, float]
    depth_errors: np.ndarray

    @cached_property
    def regions(self) -> dict[str, np.ndarray]:
        """The masks (h, w) bool of the inserted objects, of their shadows, and of what lies outside both."""
        inserted = np.any([*self.objects.values()], axis=0)
        around = binary_dilation(inserted, iterations=BORDER)
        changed = np.abs(self.truth - self.before).mean(axis=2) > SHADOW_STEP
        shadow = binary_opening(changed, np.ones((3, 3))) & ~around
        return {"object": inserted, "shadow": shadow, "outside": ~(around | shadow)}


def measure_edit(
    checkpoint: TrainedCheckpoint,
    known: DriveTruth,
    job: EditJob,
    name: str,
    inserts: Inserts,
    device_settings: DeviceSettings,
    scans: ScanRecords | None = None,
) -> tuple[dict[str, Any], np.ndarray]:
    """The figures of the objects that the edit `name` inserts, over the key frames of the world's truth of this edit,
    without provenance; and a picture (h, w, 3) uint8 whose rows are the true image, the rendering and the drive without
    the objects, where most of them is seen. With the scans of a drive whose model renders LiDAR, `lidar` has the
    figures of the rays that truly met these objects.

    Raises DatasetError where the world has no truth of the edit, or the edit inserts nothing; ConfigError as
    `edited_model`; DeviceError.
    """
    inserted = [step.insert.name for step in job.edit.steps if step.insert is not None]
    if not inserted:
        raise DatasetError(f"edit {name!r} inserts no object whose truth could be compared")
    model, device = open_model(checkpoint, device_settings)
    where = f"scene {known.recording.scene.name}, edit {name!r}"
    edited = edited_model(model, known.recording.scene, job.camera, job.edit, where, inserts)
    metrics = {kind: RegionMetrics(None, ("object", "shadow", "outside")) for kind in ("inserted", "not_inserted")}
    by_angle = {key: RegionMetrics(None, ("object",)) for key in ANGLES}
    overlaps, depths, untouched, count, shown = [], [], np.zeros(2, dtype=np.int64), 0, []
    with explain_out_of_memory(lambda: len(edited.model)):
        for frame in edit_frames(known, edited, job.camera, name, inserted, device):
            masks = frame.regions
            metrics["inserted"].add(metrics["inserted"].measure(frame.rendered, frame.truth, masks))
            metrics["not_inserted"].add(metrics["not_inserted"].measure(frame.without, frame.truth, masks))
            for id, pixels in frame.objects.items():
                for key, (low, high) in ANGLES.items():
                    if pixels.any() and low <= frame.angles.get(id, 180.0) < high:
                        own = by_angle[key]
                        own.add(own.measure(frame.rendered, frame.truth, {"object": pixels}))
                if pixels.any():
                    overlaps.append([int(both.sum()) for both in (frame.shown[id] & pixels, frame.shown[id] | pixels)])
            elsewhere = masks["outside"] & ~np.any([*frame.shown.values()], axis=0)
            changed = np.abs(frame.rendered - frame.without).max(axis=2)[elsewhere] > CHANGED
            untouched += np.count_nonzero(changed), changed.size
            depths.append(frame.depth_errors)
            shown = sorted([*shown, (-int(masks["object"].sum()), count, frame)], key=lambda one: one[:2])[:SHOWN]
            count += 1
    if not count:
        raise DatasetError(f"the truth of this world has no image of {job.camera} after edit {name!r}")
    spread = checkpoint.job.train.scans.beam_spread_rad
    lidar = None if scans is None else edited_scan_metrics(known, scans, edited, name, inserted, spread, device)
    both, either = np.sum(overlaps, axis=0) if overlaps else (0, 0)
    record = {
        "schema": 1,
        "camera": job.camera,
        "edit": job.edit.model_dump(mode="json"),
        "frames": count,
        "inserted": {**metrics["inserted"].summary(), **depth_summary(depths)},
        "not_inserted": metrics["not_inserted"].summary(),
        "by_angle_deg": {key: own.summary()["object"] for key, own in by_angle.items()},
        "mask_iou": float(both / either) if either else None,
        "changed_elsewhere": float(untouched[0] / untouched[1]) if untouched[1] else None,
        "lidar": lidar,
    }
    return record, picture([frame for _, _, frame in sorted(shown, key=lambda one: one[1])])


@torch.no_grad()
def edit_frames(
    known: DriveTruth, edited: EditedModel, camera: str, name: str, inserted: Sequence[str], device: torch.device
) -> Iterator[EditFrame]:
    """The key frames of a camera for which the world has the truth of the edit."""
    without = [actor for actor in edited.actors if actor.id not in inserted]
    for view in known.truth.edited(camera, name):
        for index, frame, truth in known.lateral_frames(view):
            shown = known.view(index, frame, device)
            at = np.array([shown.time])
            (placed,), (other,) = (placed_models(edited.model, actors, at) for actors in (edited.actors, without))
            yield _measured(known, index, frame, truth, shown, placed, other, edited.actors, inserted)


@torch.no_grad()
def edited_scan_metrics(
    known: DriveTruth, scans: ScanRecords, edited: EditedModel, name: str, inserted: Sequence[str],
    beam_spread: tuple[float, float], device: torch.device,
) -> dict[str, dict[str, Any]] | None:  # fmt: skip
    """The figures (`ScanPool.figures`) of the rays of key frames that truly met inserted objects: of the edited drive,
    and of that without the objects. None where the world has no scans after the edit. `beam_spread` in radians."""
    if not known.truth.scans_of(edit=name):
        return None
    without = [actor for actor in edited.actors if actor.id not in inserted]
    shown = {"inserted": edited.actors, "not_inserted": without}
    pools = {kind: ScanPool(chamfer=False) for kind in shown}
    truth = ScanTruth.of(known.truth, known.path, known.recording.scene, scans, own_car_radius=0.0)
    for scan, found, _ in truth.scans(edit=name):
        rays = truth.met(found, *map(known.instance_of, inserted))
        view = view_of_scan(scan, beam_spread, device)
        for kind, actors in shown.items():
            (placed,) = placed_models(edited.model, actors, np.array([view.time]))
            pools[kind].add(scan, placed.scan(view).rendered(), rays)
    return {kind: pool.figures() for kind, pool in pools.items()}


def _measured(
    known: DriveTruth, index: int, frame: Frame, truth: TruthFrame, view: View, placed: PlacedModel, other: PlacedModel,
    actors: Sequence[EditedActor], inserted: Sequence[str],
) -> EditFrame:  # fmt: skip
    size, at = known.recording.size(index), np.array([view.time])
    present = [actor for actor in actors if actor.present(at)[0]]
    instances, found = known.instances(truth.instances, size), placed.objects_in(view).cpu().numpy()
    objects = {id: instances == known.number_of(id) for id in inserted}
    rows = {actor.id: number for number, actor in enumerate(present)}
    inside = np.any([*objects.values()], axis=0)
    depth = placed.surface_depth(view).float().cpu().numpy()
    return EditFrame(
        known.image(truth.image, size) if truth.image else known.recording.image(index),
        known.recording.image(index),
        *(model.render(view).image.float().cpu().numpy().clip(0.0, 1.0) for model in (placed, other)),
        objects,
        {id: found == rows.get(id, -2) for id in inserted},
        {actor.id: _angle(actor, frame, at) for actor in present if actor.id in inserted},
        relative_depth_errors(depth, known.depth(truth.depth, size, inside)),
    )


def _angle(actor: EditedActor, frame: Frame, at: np.ndarray) -> float:
    """Degrees between the direction from which a camera shows an asset and the nearest one from which it was seen."""
    place = (inverse(actor.poses(at)[0]) @ frame.camera_to_world)[:3, 3]
    seen = np.zeros(0) if actor.seen is None else actor.seen
    turns = np.abs(np.angle(np.exp(1j * (np.arctan2(place[1], place[0]) - seen))))
    return float(np.degrees(turns.min(initial=np.pi)))


def picture(frames: Sequence[EditFrame]) -> np.ndarray:
    """A row of images of each frame: true, rendered, without the objects."""
    rows = [np.concatenate([frame.truth, frame.rendered, frame.without], axis=1) for frame in frames]
    return (np.concatenate(rows) * 255.0 + 0.5).astype(np.uint8)
