"""Writes the ground truth of a world; `drivesplat.readers.truth` describes the files."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesplat.io.storage import atomic_write
from drivesplat.readers.nuscenes.tokens import token
from drivesplat.readers.truth import (
    TRUTH_FILE,
    Truth,
    TruthFrame,
    TruthScan,
    TruthView,
    depth_units,
    write_truth_file,
)  # fmt: skip
from drivesplat.scene.images import write_png
from drivesplat.scene.rigid import apply, inverse
from drivesplat.world.optics.imaging import to_bytes
from drivesplat.world.optics.rig import SENSORS, RigSensor, image_height, key_frame_time
from drivesplat.world.recorder import STREET_TO_GLOBAL, Recorder, Viewpoint
from drivesplat.world.shapes.mesh import SurfaceClass

LIDAR = SENSORS[0]
PATTERN_FILE = "lidar/pattern.npz"
CLEARANCE = 0.3
"""Metres between a camera and the box of an object below which an image shows next to nothing else."""


@dataclass(frozen=True)
class TruthPlan:
    """A view, or scans, to write: the camera or LiDAR, its viewpoint, and the folder below truth/."""

    sensor: RigSensor
    viewpoint: Viewpoint
    folder: str


def planned(recorder: Recorder) -> list[TruthPlan]:
    """The views of each camera with truth, and the scans of the LiDAR if the settings ask for them: recorded, lateral,
    without the leading vehicle, edited."""
    truth = recorder.world.truth
    offsets = dict.fromkeys(offset for offset in truth.lateral_m if offset)
    viewpoints = {"recorded": Viewpoint()}
    viewpoints |= {f"{'left' if m > 0 else 'right'}_{abs(m):g}m": Viewpoint(left=m) for m in offsets}
    if recorder.street.leading:
        viewpoints["without_leading"] = Viewpoint(without=recorder.street.leading)
    viewpoints |= {f"edits/{name}": Viewpoint(edit=name) for name in recorder.edits}
    folders = {sensor: sensor.channel for sensor in SENSORS if sensor.channel in truth.cameras}
    folders |= {LIDAR: "lidar"} if truth.lidar else {}
    return [TruthPlan(at, view, f"{top}/{name}") for at, top in folders.items() for name, view in viewpoints.items()]


def key_frames_of(recorder: Recorder, plan: TruthPlan) -> list[int]:
    """The key frames of a view: all but those at which its camera is inside an object or about to touch one."""
    view, free = plan.viewpoint, []
    others = [it for it in recorder.variation(view.edit).street.objects if it.category and it.name != view.without]
    for index in range(recorder.world.key_frames):
        seconds = np.array([(key_frame_time(recorder.world, index) + plan.sensor.delay_us) * 1e-6])
        center = (recorder.ego_to_street(seconds, view)[0] @ plan.sensor.sensor_to_ego)[:3, 3]
        beside = ((it, np.abs(apply(inverse(it.box_poses(seconds)[0]), center[None])[0])) for it in others)
        if not any((distance < it.size / 2 + CLEARANCE).all() for it, distance in beside):
            free.append(index)
    return free


def write_frame(root: Path, recorder: Recorder, plan: TruthPlan, index: int) -> TruthFrame:
    """Renders and writes the truth of key frame `index` in a view."""
    sensor, view = plan.sensor, plan.viewpoint
    time_us = key_frame_time(recorder.world, index) + sensor.delay_us
    recorded = view == Viewpoint() and sensor.channel in (recorder.world.cameras or ())
    picture = (recorder.geometry if recorded else recorder.picture)(sensor, time_us, view)
    images = {
        "depth": depth_units(np.where(np.isfinite(picture.depth), picture.depth, 0.0)),
        "instances": _numbers_of_objects(recorder, view)[picture.objects + 1],
        "classes": np.where(picture.markings, np.uint8(SurfaceClass.MARKING), picture.classes),
    }
    if not recorded:
        images["image"] = to_bytes(picture.radiance)
    names = {kind: f"{plan.folder}/{kind}/{index:04}.png" for kind in images}
    for kind, name in names.items():
        write_png((root / TRUTH_FILE).parent / name, images[kind])
    pose = STREET_TO_GLOBAL @ recorder.camera(sensor, time_us * 1e-6, view).pose
    image = token(recorder.scene, sensor.channel, time_us)
    return TruthFrame(image, index, pose.tolist(), **{"image": None, **names})


def instance_numbers(recorder: Recorder) -> dict[str, int]:
    """The number of each annotated object by its token, from 1; the objects of the drive first, then those that edits
    add."""
    streets = [recorder.variation(edit).street for edit in (None, *recorder.edits)]
    names = dict.fromkeys(item.name for street in streets for item in street.objects if item.category)
    return {recorder.instance(name): number for number, name in enumerate(names, start=1)}


def _numbers_of_objects(recorder: Recorder, view: Viewpoint) -> np.ndarray:
    """The instance number (objects + 1,) of each object of a view's street; the first entry is that of the sky."""
    numbers = instance_numbers(recorder)
    objects = recorder.variation(view.edit).street.objects
    return np.array([0, *(numbers.get(recorder.instance(item.name), 0) for item in objects)], dtype=np.uint8)


def write_scan(root: Path, recorder: Recorder, plan: TruthPlan, index: int) -> TruthScan:
    """Casts and writes the LiDAR scan of key frame `index`."""
    view = plan.viewpoint
    time_us = key_frame_time(recorder.world, index) + LIDAR.delay_us
    found = recorder.scan(LIDAR, time_us, view)
    name = f"{plan.folder}/{index:04}.npz"
    with atomic_write((root / TRUTH_FILE).parent / name) as file:
        np.savez_compressed(
            file,
            range=found.range.astype(np.float32),
            intensity=found.intensity.astype(np.float32),
            instance=_numbers_of_objects(recorder, view)[found.object + 1],
            returned=found.returned,
        )
    without = recorder.instance(view.without) if view.without else None
    pose = STREET_TO_GLOBAL @ recorder.ego_to_street(np.array([time_us * 1e-6]), view)[0] @ LIDAR.sensor_to_ego
    sweep = token(recorder.scene, LIDAR.channel, time_us)
    return TruthScan(sweep, index, pose.tolist(), view.left, view.edit, without, name)


def write_truth(root: Path, recorder: Recorder, views: Iterable[TruthView], scans: Iterable[TruthScan]) -> None:
    """Writes truth.json, and the pattern of the scans."""
    world, leading, scans = recorder.world, recorder.street.leading, tuple(scans)
    if scans:
        pattern = recorder.pattern
        with atomic_write((root / TRUTH_FILE).parent / PATTERN_FILE) as file:
            np.savez_compressed(file, elevations=pattern.elevations, azimuths=pattern.azimuths, offsets=pattern.offsets)
    truth = Truth(
        scene=recorder.scene,
        width=world.width,
        height=image_height(world.width),
        samples_per_pixel=world.samples_per_pixel,
        leading=recorder.instance(leading) if leading else None,
        instances={str(number): token for token, number in instance_numbers(recorder).items()},
        classes={str(int(c)): c.name.lower() for c in SurfaceClass},
        views=tuple(views),
        pattern=PATTERN_FILE if scans else None,
        scans=scans,
    )
    write_truth_file(root, truth)
