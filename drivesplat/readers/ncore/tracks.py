"""Cuboid observations of a clip as the tracks of a scene: brought into one world by the pose graph, merged by their
track, and sampled at the key frames."""

import logging
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from drivesplat.readers.checks import (
    MAX_COORDINATE,
    checked_box_size,
    checked_numbers,
    checked_text,
    checked_timestamp,
)
from drivesplat.readers.ncore.pose_graph import PoseGraph
from drivesplat.readers.record_names import named
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.rigid import interpolate, rigid
from drivesplat.scene.scene import Track

log = logging.getLogger(__name__)
MIN_GAP_US, MAX_GAP_US, MAX_INTERVALS = 300_000, 1_000_000, 1.5
"""A track is interpolated between two observations that are at most so many usual intervals apart, within these bounds
in microseconds."""
MAX_ANGLE = 100.0
_NAMES = {
    ObjectClass.CAR: "automobile passenger_car regular_vehicle sedan suv van pickup taxi",
    ObjectClass.TRUCK: "heavy_truck large_truck box_truck truck_cab pickup_truck semi_truck",
    ObjectClass.BUS: "trolley_bus school_bus articulated_bus bus_bendy bus_rigid coach",
    ObjectClass.TRAILER: "vehicular_trailer traffic_control_trailer message_board_trailer",
    ObjectClass.CONSTRUCTION_VEHICLE: "construction",
    ObjectClass.TRAM: "train train_or_tram_car railed_vehicle",
    ObjectClass.VEHICLE: (
        "other_vehicle large_vehicle emergency_vehicle ambulance police police_car fire_truck misc_vehicle "
        "emergency_ambulance emergency_police unknown_vehicle vehicle_other"
    ),
    ObjectClass.MOTORCYCLE: "motorbike",
    ObjectClass.BICYCLE: "bike wheeled_device",
    ObjectClass.RIDER: (
        "cyclist bicyclist motorcyclist wheeled_rider bicycle_rider motorcycle_rider person_on_rideables"
    ),
    ObjectClass.PEDESTRIAN: (
        "person human walker adult child person_sitting official_signaler construction_worker police_officer "
        "personal_mobility"
    ),
    ObjectClass.ANIMAL: "dog",
    ObjectClass.OTHER_MOVABLE: (
        "protruding_object stroller wheelchair sign unknown misc dontcare bollard construction_cone "
        "construction_barrel traffic_cone trafficcone barrier stop_sign mobile_pedestrian_crossing_sign "
        "pushable_pullable debris bicycle_rack traffic_light_trailer"
    ),
}
"""Other names of classes: those of Physical AI AV, Waymo, Argoverse 2, KITTI and nuScenes."""
_CLASSES = {kind.value: kind for kind in ObjectClass}
_CLASSES |= {name: kind for kind, names in _NAMES.items() for name in names.split()}
_GROUPS = ("vehicle", "human_pedestrian", "human", "movable_object", "static_object", "type", "label")
"""What names begin with in datasets whose names have parts, such as vehicle.bus.rigid and TYPE_VEHICLE."""


def tracks_of(
    observations: Sequence[Any], poses: PoseGraph, world_to_scene: np.ndarray, key_times: np.ndarray
) -> Iterator[Track]:
    """The objects seen at any key frame, in the order of their first observation, each with the median size and the
    most frequent label of its observations. Unknown labels are other_movable, which is logged. Raises DatasetError
    naming a damaged observation."""
    by_id = merged(observations, poses)
    intervals = [np.diff(sorted(of_track)) for of_track in by_id.values() if len(of_track) > 1]
    usual = float(np.median(np.concatenate(intervals))) if intervals else 0.0
    max_gap = float(np.clip(MAX_INTERVALS * usual, MIN_GAP_US, MAX_GAP_US))
    half = float(np.median(np.diff(key_times))) / 2 if len(key_times) > 1 else max_gap / 2
    unknown: Counter[str] = Counter()
    for id_, of_track in by_id.items():
        times = np.array(sorted(of_track), dtype=np.int64)
        ordered = [of_track[int(time)] for time in times]
        label = Counter(checked_text(one.class_id, named("cuboid", id_), "class_id") for one in ordered)
        category = label.most_common(1)[0][0]
        kind = object_class(category)
        sampled = sampled_poses(
            times, [world_to_scene @ pose_of(one, poses) for one in ordered], key_times, max_gap, half
        )
        sizes = [checked_box_size(list(one.bbox3.dim), named("cuboid", id_)) for one in ordered]
        if not sampled:
            continue
        if kind is None:
            unknown[category] += 1
        indices = list(sampled)
        yield Track(
            id=id_,
            object_class=kind or ObjectClass.OTHER_MOVABLE,
            category=category,
            size=np.median(sizes, axis=0),
            timestamps=key_times[indices],
            sample_indices=np.array(indices, dtype=np.int64),
            object_to_world=np.stack(list(sampled.values())),
            visibility=np.zeros(len(indices), dtype=np.int64),
        )
    if unknown:
        names = ", ".join(f"{name} ({count})" for name, count in sorted(unknown.items()))
        log.warning("cuboids have unknown labels, which are read as other_movable and count as static: %s", names)


def merged(observations: Sequence[Any], poses: PoseGraph) -> dict[str, dict[int, Any]]:
    """The observations of each track by their times. Of several at one time, the one of the best source counts: manual
    labels before automatic ones. Those beyond the known path are left out, which is logged."""
    by_id: dict[str, dict[int, Any]] = {}
    beyond = 0
    for observation in observations:
        record = named("cuboid", observation.track_id)
        time = checked_timestamp(observation.timestamp_us, record)
        of_track = by_id.setdefault(checked_text(observation.track_id, record, "track_id"), {})
        if not is_known(observation, poses):
            beyond += 1
        elif time not in of_track or observation.source > of_track[time].source:
            of_track[time] = observation
    if beyond:
        log.warning("%d of %d cuboids lie beyond the known path; left out", beyond, len(observations))
    return {id_: of_track for id_, of_track in by_id.items() if of_track}


def is_known(observation: Any, poses: PoseGraph) -> bool:
    """Whether the pose of an observation's frame of reference is known at its time. Raises DatasetError naming the
    track where the clip has no such frame of reference."""
    record = named("cuboid", observation.track_id)
    first, last = poses.span(checked_text(observation.reference_frame_id, record, "reference_frame_id"), "world")
    return first <= checked_timestamp(observation.reference_frame_timestamp_us, record) <= last


def pose_of(observation: Any, poses: PoseGraph) -> np.ndarray:
    """The pose (4, 4) of a box in the world of the clip. Raises DatasetError naming the track."""
    record = named("cuboid", observation.track_id)
    frame, time = observation.reference_frame_id, observation.reference_frame_timestamp_us
    center = checked_numbers(observation.bbox3.centroid, 3, MAX_COORDINATE, record, "centroid", "metres")
    angles = checked_numbers(observation.bbox3.rot, 3, MAX_ANGLE, record, "rotation", "radians")
    return poses.at(frame, "world", [time])[0] @ rigid(Rotation.from_euler("xyz", angles).as_matrix(), center)


def sampled_poses(
    times: np.ndarray, poses: Sequence[np.ndarray], key_times: np.ndarray, max_gap: float, reach: float
) -> dict[int, np.ndarray]:
    """The pose (4, 4) of an object at each key frame at which it is observed, by index. `poses` at increasing `times`
    (n,) are interpolated where these are at most `max_gap` microseconds apart; beyond an end, up to `reach`
    microseconds, the motion next to it continues, since boxes have the times at which a sensor met them."""
    found: dict[int, np.ndarray] = {}
    for index, key in enumerate(key_times.tolist()):
        after = int(np.searchsorted(times, key))
        if after < len(times) and times[after] == key:
            found[index] = poses[after]
        elif 0 < after < len(times) and times[after] - times[after - 1] <= max_gap:
            share = float((key - times[after - 1]) / (times[after] - times[after - 1]))
            found[index] = interpolate(poses[after - 1], poses[after], share)
        else:
            nearest = min((i for i in (after - 1, after) if 0 <= i < len(times)), key=lambda i: abs(times[i] - key))
            if abs(int(times[nearest]) - key) <= reach:
                found[index] = _continued(times, poses, nearest, key, max_gap)
    return found


def _continued(times: np.ndarray, poses: Sequence[np.ndarray], nearest: int, key: int, max_gap: float) -> np.ndarray:
    """The pose at `key` by the motion between the observation `nearest` to it and the one on its other side; that
    observation where there is none within `max_gap`."""
    other = nearest + (1 if key < times[nearest] else -1)
    if not 0 <= other < len(times) or abs(times[other] - times[nearest]) > max_gap:
        return poses[nearest]
    return interpolate(poses[nearest], poses[other], float((key - times[nearest]) / (times[other] - times[nearest])))


def object_class(label: str) -> ObjectClass | None:
    """The class of a label, in upper or lower case and with any signs between its words; None if it is unknown."""
    name = re.sub(r"[^a-z0-9]+", "_", label.lower()).strip("_")
    for group in _GROUPS:
        found = _CLASSES.get(name)
        if found is not None:
            return found
        name = name.removeprefix(f"{group}_")
    return _CLASSES.get(name)
