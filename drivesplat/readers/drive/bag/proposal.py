"""The proposed map of a bag: a topics.yaml with the reason of each decision as a comment."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
import yaml

from drivesplat.errors import DatasetError
from drivesplat.io.unique_names import unique_names
from drivesplat.readers.drive.bag.bag_map import TF, quoted
from drivesplat.readers.drive.bag.clouds import POINT_CLOUD
from drivesplat.readers.drive.bag.images import CAMERA_INFO, RAW_IMAGE, image_file
from drivesplat.readers.drive.bag.layouts import cloud_layout
from drivesplat.readers.drive.bag.survey import BagSurvey, TopicSurvey, clock_fault
from drivesplat.readers.drive.bag.transforms import ODOMETRY, TransformTree

VEHICLES = ("base_footprint", "base_link", "vehicle", "ego_vehicle", "ego", "imu_link", "imu")
WORLDS = ("map", "odom", "world", "earth", "utm")
"""Names of the frames of vehicle and world, the most usual first."""
NO_NAMES = {
    "image", "image_raw", "image_rect", "image_rect_color", "image_color", "image_mono", "compressed", "points",
    "points_raw", "point_cloud", "pointcloud", "pointcloud2", "cloud", "raw", "camera", "cameras", "sensing", "sensors",
    "lidar", "rectified", "color", "rgb",
}  # fmt: skip
"""Parts of topics that name no sensor."""
MIN_KEY_INTERVAL_S = 0.09
"""Least time between proposed key frames, where images come faster than at 10 Hz."""
MAX_REVOLUTION_S = 0.25
"""Time between sweeps up to which it is taken for that of a revolution."""
SPAN_MARGIN = 1.02
"""Factor on the time between the first and the last point of a sweep, which varies from sweep to sweep."""
AXES_OPTICAL, AXES_FORWARD = "optical", "forward"


@dataclass(frozen=True)
class Line:
    """A line of YAML and its comment."""

    text: str
    reason: str = ""


def proposed_map(found: BagSurvey, tree: TransformTree, source: str) -> str:
    """The text of the map proposed for a bag called `source`, of its first messages and transforms.

    Raises DatasetError where no images and no point clouds are there, or none can be used.
    """
    sensors = _sensors(found)
    if not sensors:
        raise DatasetError(f"{source} has no images and no point clouds: there is nothing to import")
    world, vehicle, poses = _frames(found, tree)
    cameras = {name: topic for name, topic in sensors.items() if topic.is_image}
    lidars = {name: topic for name, topic in sensors.items() if not topic.is_image}
    lines = [
        Line(f"# Proposed for {source} by `drivesplat import bag`. Comments are the reasons; change what is wrong."),
        _clock(found),
        world, vehicle,
        Line("vehicle_to_ego: {translation: [0, 0, 0], rotation: [1, 0, 0, 0]}",
             "the vehicle's frame is taken to be on the ground below the rear axle; [0, 0, 0.3] if it is 0.3 m higher"),
        poses,
    ]  # fmt: skip
    frame = yaml.safe_load(vehicle.text)["vehicle"]
    if cameras:
        lines.append(Line("cameras:"))
        for name, topic in cameras.items():
            lines += _camera(name, topic, found, tree, frame)
    if lidars:
        lines.append(Line("lidars:"))
        for name, topic in lidars.items():
            lines += _lidar(name, topic)
    lines.append(_key_frames(cameras, lidars))
    if any(topic.kind == RAW_IMAGE for topic in cameras.values()):
        lines.append(Line("raw_images: png", "loses nothing; jpeg takes less space"))
    used = {topic.name for topic in sensors.values()}
    lines += [
        Line(f"# not used: {_printable(topic.name)}", why)
        for topic in found.topics.values()
        if topic.name not in used and (why := _why_not(topic, found))
    ]
    return "".join(f"{line.text}{f'  # {_printable(line.reason)}' if line.reason else ''}\n" for line in lines)


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() else " " for letter in text)


def _sensors(found: BagSurvey) -> dict[str, TopicSurvey]:
    """The topics of sensors by the names proposed for them, cameras first, the one that may look ahead first."""
    chosen = [topic for topic in found.topics.values() if _is_sensor(topic) and not _why_not(topic, found)]
    chosen.sort(key=lambda topic: (not topic.is_image, "front" not in topic.name.lower(), topic.name))
    names = unique_names([topic.name for topic in chosen], _plain_name)
    return {names[topic.name]: topic for topic in chosen}


def _is_sensor(topic: TopicSurvey) -> bool:
    return topic.is_image or topic.kind == POINT_CLOUD


def _plain_name(topic: str) -> str:
    parts = [part for part in PurePath(topic).parts if part != "/"]
    named = [part for part in parts if part.lower() not in NO_NAMES] or parts
    plain = re.sub(r"[^A-Za-z0-9]+", "_", named[-1]).strip("_")
    return plain if quoted(plain) == plain else f"sensor_{plain}"  # YAML takes 0 and on for other things


def _why_not(topic: TopicSurvey, found: BagSurvey) -> str:
    """Why a topic of images or points is not proposed; empty for those that are, and for all other topics."""
    if not _is_sensor(topic):
        return ""
    if not topic.samples:
        return "no message of it can be read between --start and --end"
    if topic.count < 2:
        return "it has one message"
    if topic.kind == POINT_CLOUD:
        try:
            cloud_layout(topic.samples[0])
        except DatasetError as error:
            return f"its cloud {error}"
        return ""
    others = [other for other in found.topics.values() if other.is_image and other.name != topic.name]
    if topic.kind == RAW_IMAGE and any(other.name == f"{topic.name}/compressed" for other in others):
        return "its compressed images are there, too"
    try:
        image_file(topic.samples[0], "png")
    except DatasetError as error:
        return f"its image {error}"
    return ""


def _clock(found: BagSurvey) -> Line:
    topics = [topic for topic in found.topics.values() if topic.ahead_s is not None]
    if fault := clock_fault(topics):
        return Line("clock: log", f"{fault}; log times are exact to the delay of the recording only")
    ahead = [abs(topic.ahead_s or 0.0) for topic in topics]
    near = f"they are within {max(ahead, default=0.0):.3f} s of the times of recording"
    far = "all of them differ from the times of recording by the same"
    return Line("clock: header", f"stamps of the headers: {near if max(ahead, default=0.0) < 10 else far}")


def _frames(found: BagSurvey, tree: TransformTree) -> tuple[Line, Line, Line]:
    """World, vehicle and source of poses."""
    frames, odometry = tree.frames, found.of_kind(ODOMETRY)
    tops = [name for name in frames if all(edge.child != name for edge in tree.edges)]
    vehicle = next((name for name in VEHICLES if name in frames), None)
    for world in dict.fromkeys([*(name for name in WORLDS if name in frames), *tops]):
        for below in dict.fromkeys([*([vehicle] if vehicle else []), *frames]):
            route = tree.route(below, world) if below != world else None
            if route and any(not edge.latched for edge, _ in route):
                why = "the usual name" if below in VEHICLES else "the first frame that moves; name that of the vehicle"
                other = "; odom drifts but never jumps" if world == "map" and "odom" in frames else ""
                return (
                    Line(f"world: {quoted(world)}", f"{below} moves in it by /tf{other}"),
                    Line(f"vehicle: {quoted(below)}", why),
                    Line(f"poses: {TF}", "tf connects vehicle and world; a topic of Odometry would do, too"),
                )
    if odometry and odometry[0].samples:
        one = odometry[0].samples[0]
        child = str(one.child_frame_id).lstrip("/") or vehicle or "base_link"
        return (
            Line(f"world: {quoted(odometry[0].frame or 'odom')}", f"the frame of {odometry[0].name}"),
            Line(f"vehicle: {quoted(child)}", f"the child frame of {odometry[0].name}"),
            Line(f"poses: {quoted(odometry[0].name)}", "tf does not connect a vehicle with a world"),
        )
    return (
        Line("world: map", "no transform or odometry moves"),
        Line(f"vehicle: {quoted(vehicle or 'base_link')}", "the usual name"),
        Line("poses: null", "there are none: they are estimated from images and LiDAR (docs/poses.md)"),
    )


def _camera(name: str, topic: TopicSurvey, found: BagSurvey, tree: TransformTree, vehicle: str) -> Iterator[Line]:
    grey = _grey(topic)
    others = [other for other in found.topics.values() if other.is_image and other.samples and not _grey(other)]
    alone = "grey images beside colour ones: leave it out of `cameras` in the config"
    yield Line(f"  {name}:", alone if grey and others else "")
    yield Line(f"    images: {quoted(topic.name)}", topic.kind.rpartition("/")[2] + (", grey" if grey else ""))
    info = _info(topic, found)
    none = "no CameraInfo belongs to it: state calibration: {width: …, height: …, K: …} in place of info"
    yield Line(f"    info: {quoted(info) if info else 'null'}", "beside the images" if info else none)
    rectified = re.search(r"(^|[/_])rect(ified)?([/_]|$)", topic.name) is not None
    yield Line(
        f"    rectified: {str(rectified).lower()}", f"its topic is {'' if rectified else 'not '}called rectified"
    )
    frame, axes, why = _camera_frame(topic, tree, vehicle)
    yield Line(f"    frame: {quoted(frame)}", "the frame of its headers")
    yield Line(f"    axes: {axes}", why)
    yield Line("    stamp: middle", "the part of the exposure that drivers stamp is unknown: no shift")
    yield Line("    exposure_s: 0.0", "only used where stamp is start or end")


def _grey(topic: TopicSurvey) -> bool:
    try:
        return all(image_file(sample, "png").grey for sample in topic.samples)
    except DatasetError:
        return False


def _info(topic: TopicSurvey, found: BagSurvey) -> str | None:
    """The topic of CameraInfo in the innermost namespace around the images' topic."""
    infos = [info.name for info in found.of_kind(CAMERA_INFO) if info.samples]
    for parent in PurePath(topic.name).parents:
        beside = [name for name in infos if PurePath(name).parent == parent]
        if parent != PurePath("/") and len(beside) == 1:
            return beside[0]
    same = [info.name for info in found.of_kind(CAMERA_INFO) if info.samples and info.frame == topic.frame]
    return same[0] if len(same) == 1 else None


def _camera_frame(topic: TopicSurvey, tree: TransformTree, vehicle: str) -> tuple[str, str, str]:
    """The frame, its axes and their reason."""
    frame = topic.frame or "camera"
    if "optical" in frame:
        return frame, AXES_OPTICAL, "its name says so"
    if tree.route(frame, vehicle) is None:
        return frame, AXES_OPTICAL, "as ROS has frames of images; tf does not know it: state its mount"
    mount = tree.poses(frame, vehicle, np.zeros(1, dtype=np.int64))[0]
    if abs(mount[2, 2]) > 0.8:
        return frame, AXES_FORWARD, "its z axis is vertical in tf"
    return frame, AXES_OPTICAL, "its z axis is level in tf"


def _lidar(name: str, topic: TopicSurvey) -> Iterator[Line]:
    cloud = topic.samples[0]
    layout = cloud_layout(cloud)
    span = max(cloud_layout(sample).span_s for sample in topic.samples)
    interval = topic.interval_s if topic.interval_s and 1e-3 < topic.interval_s <= MAX_REVOLUTION_S else 0.0
    revolution = f"{interval if interval >= span else SPAN_MARGIN * span:.4g}" if interval or span else "null"
    why = "unknown: sweeps follow each other at longer intervals"
    if revolution != "null":
        why = "the time between its first sweeps" if interval >= span else "2 % more than points span"
    yield Line(f"  {name}:")
    yield Line(f"    points: {quoted(topic.name)}", f"fields {', '.join(str(one.name) for one in cloud.fields)}")
    yield Line(f"    frame: {quoted(topic.frame or 'lidar')}", "the frame of its headers")
    yield Line(f"    revolution_s: {revolution}", why)
    yield Line("    stamp: start", "as drivers stamp; only used where times count from start")
    yield Line(f"    time: {layout.time}", layout.time_reason)
    yield Line(f"    motion_compensated: {str(layout.compensated).lower()}", layout.compensated_reason)
    yield Line(f"    ring: {layout.ring}", layout.ring_reason)
    yield Line(f"    intensity: {layout.intensity}", "counts as 1 from intensity_scale on")
    yield Line(f"    intensity_scale: {layout.scale:g}", layout.scale_reason)


def _key_frames(cameras: dict[str, TopicSurvey], lidars: dict[str, TopicSurvey]) -> Line:
    first = next(iter(cameras or lidars))
    fast = ((cameras or lidars)[first].interval_s or 1.0) < MIN_KEY_INTERVAL_S
    least = MIN_KEY_INTERVAL_S if fast else 0.0
    what = "images" if cameras else "sweeps"
    why = f"{what} of {first}" + (", at most about 10 a second" if fast else ", all of them")
    return Line(f"key_frames: {{sensor: {first}, min_interval_s: {least:g}}}", why)
