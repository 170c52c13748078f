"""The stage `lidar_seed`: where the Gaussians start.

LiDAR of the training sweeps in world coordinates, without the own car and without what moves, thinned, coloured
from training images; then points of a file, if given; then far points along pixels that none of these cover. Held-out
images and sweeps contribute nothing, neither position (of LiDAR) nor colour, and a point that no training image sees is
left out.
"""

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from plyfile import PlyParseError

from drivesplat.ahead import ahead
from drivesplat.errors import DatasetError
from drivesplat.holdout import frame_groups, sweep_groups
from drivesplat.images import continuous_intrinsics, read_image, target_size
from drivesplat.point_cloud import PointCloud, read_positions
from drivesplat.regions import fill, hulls_in
from drivesplat.rigid import apply, inverse
from drivesplat.scene import Frame, Scene
from drivesplat.seeding.coloring import ColorView, color_by_visibility
from drivesplat.seeding.far_points import far_points
from drivesplat.seeding.sweeps import outside_boxes, read_sweep, thin, without_own_car
from drivesplat.settings.images import ImageSettings
from drivesplat.settings.lidar_seed import SeedJob
from drivesplat.tracks import boxes_of, tracks_that_move

log = logging.getLogger(__name__)


def seed_points(scene: Scene, job: SeedJob) -> PointCloud:
    """The seed of a scene. Its note counts points by source, missing sweeps, and names the points file.

    Raises DatasetError where a LiDAR file is missing (unless told to go on) or nothing is left to start from.
    """
    random = np.random.default_rng(job.random_seed)
    frames = training_frames(scene, job)
    if not frames:
        raise DatasetError(
            f"scene {scene.name}: the hold-out leaves none of its {len(scene.key_frame_timestamps)} key frames to "
            "train on; lower holdout.last_block, or set holdout.every_nth: 0"
        )
    lidar, times, missing = lidar_points(scene, job)
    extra = extra_points(scene, job.lidar_seed.points_file)
    positions = np.concatenate([lidar, extra])
    times = np.concatenate([times, np.full(len(extra), np.median(scene.key_frame_timestamps))])
    from_file = np.arange(len(positions)) >= len(lidar)
    colors, seen = color_by_visibility(positions, times, color_views(scene, frames, job.images))
    kept = np.flatnonzero(seen)
    if len(kept) > job.lidar_seed.max_points:
        kept = np.sort(random.choice(kept, job.lidar_seed.max_points, replace=False))
    positions, colors, from_file = positions[kept], colors[kept], from_file[kept]
    far, far_colors = _far_points(scene, frames, positions, job, random)
    note = {
        "lidar": int((~from_file).sum()),
        "points_file": int(from_file.sum()),
        "far": len(far),
        "lidar_missing": missing,
        "extra_points": Path(job.lidar_seed.points_file).name if job.lidar_seed.points_file else None,
    }
    if len(positions) + len(far) == 0:
        raise DatasetError(
            f"scene {scene.name}: no seed points: "
            "no LiDAR return is seen by a training image, and there are no far points (lidar_seed.far_points)"
        )
    log.info("%d seed points: %s", len(positions) + len(far), note)
    return PointCloud(np.concatenate([positions, far]).astype(np.float32), np.concatenate([colors, far_colors]), note)


def lidar_points(scene: Scene, job: SeedJob) -> tuple[np.ndarray, np.ndarray, int]:
    """Static LiDAR points (n, 3) of the training sweeps in world coordinates, their times (n,), and the sweeps missing.

    Raises DatasetError where the scene has no LiDAR at all and on_missing is 'stop'.
    """
    settings = job.lidar_seed
    if not scene.sweeps and settings.on_missing == "stop":
        raise DatasetError(
            f"scene {scene.name} has no LiDAR sweeps; set lidar_seed.on_missing: warn to seed from images alone"
        )
    positions, times, missing = [np.empty((0, 3))], [np.empty(0)], 0
    moving = tracks_that_move(scene)
    for sweep, group in zip(scene.sweeps, sweep_groups(scene, job.holdout), strict=True):
        try:
            points = read_sweep(sweep)
        except DatasetError as error:
            if settings.on_missing == "stop":
                raise
            missing += 1
            log.log(logging.WARNING if missing == 1 else logging.DEBUG, "%s", error)
            continue
        if group != "train":
            continue
        points = apply(sweep.sensor_to_world, without_own_car(points, settings.own_car_radius))
        boxes = boxes_of(moving, sweep.timestamp, scene.key_frame_interval)
        points = points[outside_boxes(points, boxes, settings.box_margin)]
        positions.append(points)
        times.append(np.full(len(points), sweep.timestamp, dtype=np.float64))
    if missing:
        log.warning("%d of %d LiDAR sweeps are missing; seeding without them", missing, len(scene.sweeps))
    merged, merged_times = np.concatenate(positions), np.concatenate(times)
    kept = thin(merged, settings.voxel_size)
    return merged[kept], merged_times[kept], missing


def extra_points(scene: Scene, path: str | None) -> np.ndarray:
    """The points (n, 3) of a PLY in the dataset's global frame, in world coordinates; none without a path."""
    if path is None:
        return np.empty((0, 3))
    try:
        return read_positions(Path(path).expanduser()) - scene.origin
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise DatasetError(f"lidar_seed.points_file {path} is no readable PLY of points ({error})") from error


def training_frames(scene: Scene, job: SeedJob) -> list[Frame]:
    """The images that colours may come from."""
    groups = frame_groups(scene, job.holdout)
    return [frame for frame, group in zip(scene.frames, groups, strict=True) if group == "train"]


def color_views(scene: Scene, frames: list[Frame], images: ImageSettings) -> Iterator[ColorView]:
    """The frames one by one as sources of colour: at 12 Hz all of them would not fit into memory."""
    return ahead(lambda frame: color_view(scene, frame, images), frames)


def color_view(scene: Scene, frame: Frame, images: ImageSettings) -> ColorView:
    """A frame as a source of colour; pixels of moving boxes are not usable."""
    size = target_size(frame, images)
    usable = np.ones((size[1], size[0]), dtype=bool)
    for hull in hulls_in(scene, frame, size):
        if hull.box.moves:
            usable[fill(hull.polygon, size)] = False
    return ColorView(
        read_image(frame.image_path, size),
        continuous_intrinsics(frame, size),
        inverse(frame.camera_to_world),
        frame.timestamp,
        usable,
    )


def _far_points(
    scene: Scene, frames: list[Frame], covered: np.ndarray, job: SeedJob, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    settings = job.lidar_seed
    positions, colors = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.uint8)]
    shares = np.diff(settings.far_points * np.arange(len(frames) + 1) // len(frames)).tolist()
    for frame, view, count in zip(frames, color_views(scene, frames, job.images), shares, strict=True):
        ground_z = float(frame.ego_to_world[2, 3])
        p, c = far_points(view, ground_z, covered, count, settings.far_depths, random)
        positions.append(p)
        colors.append(c)
    return np.concatenate(positions), np.concatenate(colors)
