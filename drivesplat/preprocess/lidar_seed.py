"""The stage `lidar_seed`: the initial points of the static Gaussians.

The sources are static LiDAR returns of the training sweeps, without the ego vehicle and thinned; points triangulated by
pose refinement that two training images see; points of a file, if given; and far points along pixels that none of these
cover. Above points that are higher than the ground far points have the depth of these, elsewhere a random one, or that
of points that are near in the image. Colours come from training images, and points that none of them sees are left out.
Held-out images and sweeps contribute neither LiDAR positions nor colours.
"""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from plyfile import PlyParseError
from scipy.spatial import cKDTree

from drivesplat.errors import DatasetError
from drivesplat.io.point_cloud import PointCloud, read_positions
from drivesplat.io.prefetch import prefetch
from drivesplat.lidar.coloring import ColorView, KeptViews, color_by_visibility, in_image
from drivesplat.lidar.sweeps import outside_boxes, thin, world_returns
from drivesplat.preprocess.poses.triangulated import TriangulatedPoints
from drivesplat.readers.outline import without_lidar, without_training
from drivesplat.readers.sweeps import sweep_fault
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.images import continuous_intrinsics, read_image, target_size
from drivesplat.scene.recorded_shutters import shutter_of
from drivesplat.scene.regions import fill, hulls_in
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.splits import sweep_groups, training_images
from drivesplat.scene.tracks import boxes_of, moving_tracks
from drivesplat.settings.images import ImageSettings
from drivesplat.settings.lidar_seed import SeedJob

log = logging.getLogger(__name__)

THINNED_TOGETHER = 2_000_000
"""Number of new points at which all are thinned, so that memory grows with occupied voxels and not with sweeps."""
COVERAGE_CELL = 8
"""Edge length in pixels of the image cell that a seed point covers."""
RAISED = 1.0
"""Minimum height in metres, above the ground under the ego vehicle, of a seed point that counts as upright."""
MIN_SEEN = 0.05
"""Minimum share of the points of a file that training images see, below which a warning names its likely causes."""
MAX_AWAY = 1000.0
"""Maximum median distance in metres of the points of a file from the nearest camera, above which the same is said."""
NEAR_CELLS, NEAREST, SPREAD = 12, 4, 0.05
"""Of far points at depths of what is near in the image: the maximum distance in cells; the number of nearest covered
cells of which the farthest point counts, since points in front of a surface veil it; and the relative standard
deviation of depths around it."""


def seed_points(
    scene: Scene, job: SeedJob, ego_mask: EgoMask = NO_EGO_MASK, triangulated: TriangulatedPoints | None = None
) -> PointCloud:
    """The seed points of a scene in world metres; the ego vehicle's pixels give no colour. `triangulated` is the
    content of triangulated.npz. The note counts points by source and missing sweeps, and names the points file.

    Raises DatasetError where a LiDAR file is missing and on_missing is 'stop', or where no points are left.
    """
    random = np.random.default_rng(job.random_seed)
    frames = [scene.frames[i] for i in training_images(scene, job.holdout)]
    if not frames:
        raise DatasetError(without_training(scene.name, len(scene.key_frame_timestamps)))
    lidar, times, missing = lidar_points(scene, job)
    middle = float(np.median(scene.key_frame_timestamps))
    extra = extra_points(scene, job.lidar_seed.points_file)
    sources = {
        "lidar": (lidar, times),
        "triangulated": triangulated_points(scene, job, triangulated) if triangulated else (np.empty((0, 3)), []),
        "points_file": (extra, np.full(len(extra), middle)),
    }
    positions, times = (np.concatenate(columns) for columns in zip(*sources.values(), strict=True))
    source = np.repeat(np.arange(len(sources)), [len(points) for points, _ in sources.values()])
    views = KeptViews(lambda i: color_view(scene, frames[i], job.images, ego_mask))
    colors, seen = color_by_visibility(positions, times, prefetch(views.__getitem__, range(len(frames))))
    if job.lidar_seed.points_file:
        of_file = seen[source == list(sources).index("points_file")] > 0
        _warn_of_misplaced(scene, frames, Path(job.lidar_seed.points_file).name, extra, of_file)
    kept = np.flatnonzero(seen)
    if len(kept) > job.lidar_seed.max_points:
        kept = np.sort(random.choice(kept, job.lidar_seed.max_points, replace=False))
    positions, colors, source = positions[kept], colors[kept], source[kept]
    ground = [float(frame.ego_to_world[2, 3]) for frame in frames]

    def view_of(i: int) -> tuple[int, ColorView, Uncovered]:
        view = views[i]
        return i, view, uncovered(view, positions, ground[i])

    settings, parts = job.lidar_seed, [(np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8))]
    shares = np.diff(settings.far_points * np.arange(len(frames) + 1) // len(frames)).tolist()
    for i, view, candidates in prefetch(view_of, range(len(frames))):
        parts.append(far_points(view, ground[i], candidates, shares[i], settings.far_depths, random, settings.far_near))
    far, far_colors = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    note = {
        **{name: int((source == i).sum()) for i, name in enumerate(sources)},
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
    """Static LiDAR points (n, 3) of the training sweeps in world coordinates, their times (n,) in microseconds, and the
    number of missing sweeps. Raises DatasetError where the scene has no LiDAR or a sweep is missing and on_missing is
    'stop'."""
    settings = job.lidar_seed
    if not scene.sweeps and settings.on_missing == "stop":
        raise DatasetError(without_lidar(scene.name))
    kept, new, missing = (np.empty((0, 3)), np.empty(0)), [], 0
    moving = moving_tracks(scene)
    for sweep, group in zip(scene.sweeps, sweep_groups(scene, job.holdout), strict=True):
        try:
            points = world_returns(sweep, settings.own_car_radius)
        except DatasetError:
            if settings.on_missing == "stop":
                raise
            missing += 1
            log.log(logging.WARNING if missing == 1 else logging.DEBUG, "%s; left out", sweep_fault(sweep))
            continue
        if group != "train":
            continue
        boxes = boxes_of(moving, sweep.timestamp, scene.key_frame_interval)
        points = points[outside_boxes(points, boxes, settings.box_margin)]
        new.append((points, np.full(len(points), sweep.timestamp, dtype=np.float64)))
        if settings.voxel_size and sum(len(points) for points, _ in new) > THINNED_TOGETHER:
            kept, new = _thinned([kept, *new], settings.voxel_size), []
    if missing:
        log.warning("%d of %d LiDAR sweeps are missing; seeding without them", missing, len(scene.sweeps))
    return *_thinned([kept, *new], settings.voxel_size), missing


def _thinned(parts: Sequence[tuple[np.ndarray, np.ndarray]], voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """Points and times of all parts, with the first point of each voxel alone: those that stay are the same in
    whatever groups sweeps are thinned."""
    positions, times = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    kept = thin(positions, voxel)
    return positions[kept], times[kept]


def extra_points(scene: Scene, path: str | None) -> np.ndarray:
    """The points (n, 3) of a PLY file in the dataset's global frame, in world coordinates; empty without a path."""
    if path is None:
        return np.empty((0, 3))
    try:
        return read_positions(Path(path).expanduser()) - scene.origin
    except (OSError, PlyParseError, KeyError, ValueError) as error:
        raise DatasetError(f"lidar_seed.points_file {path} is not a readable PLY file of points ({error})") from error


def _warn_of_misplaced(
    scene: Scene, frames: list[Frame], name: str, points: Float[np.ndarray, "n 3"], seen: Bool[np.ndarray, " n"]
) -> None:
    """Warns where training images see hardly any of the world points of a file, or these are far away, as in another
    frame of reference or unit."""
    if not len(points):
        log.warning("lidar_seed.points_file: %s holds no points", name)
        return
    places = np.stack([frame.camera_to_world[:3, 3] for frame in frames])
    away = float(np.median(cKDTree(places).query(np.nan_to_num(points))[0]))
    if seen.mean() >= MIN_SEEN and away <= MAX_AWAY:
        return
    log.warning(
        "lidar_seed.points_file: %s of %d points of %s %s seen by a training image, and they are %.0f m from the "
        "nearest one (median); they must be in the global frame, in which this scene begins at (%.1f, %.1f, %.1f), "
        "and in metres",
        int(seen.sum()) or "none", len(seen), name, "is" if seen.sum() < 2 else "are", away, *scene.origin,
    )  # fmt: skip


def triangulated_points(scene: Scene, job: SeedJob, record: TriangulatedPoints) -> tuple[np.ndarray, np.ndarray]:
    """The triangulated points (n, 3) that enough training images see, in world coordinates, and the mean times (n,) of
    those images in microseconds."""
    training = training_images(scene, job.holdout)
    times = np.array([frame.timestamp for frame in scene.frames], dtype=np.float64)
    chosen = record.seen_in(training)
    return record.points[chosen], record.mean_over_views(training, times)[chosen]


def color_view(scene: Scene, frame: Frame, images: ImageSettings, ego_mask: EgoMask = NO_EGO_MASK) -> ColorView:
    """A frame as a source of colour; pixels of dynamic boxes and of the ego vehicle are not usable."""
    size = target_size(frame, images)
    usable = ~ego_mask.pixels(frame.camera, size)
    for hull in hulls_in(scene, frame, size):
        if hull.box.moves:
            usable[fill(hull.polygon, size)] = False
    return ColorView(
        read_image(frame.image_path, size),
        continuous_intrinsics(frame, size),
        inverse(frame.camera_to_world),
        frame.timestamp,
        usable,
        shutter_of(scene, frame),
    )


class Uncovered(NamedTuple):
    """Pixels of a view that no seed point covers: their flat row-major indices; and by cell of COVERAGE_CELL pixels
    depths along the axis (metres), inf where there is none: `nearest`, that of the nearest seed point, and `upright`,
    at which something upright may continue to the cell from the seed points below."""

    pixels: Int[np.ndarray, " m"]
    nearest: Float[np.ndarray, "rows columns"]
    upright: Float[np.ndarray, "rows columns"]

    def depths_near(
        self, rows: Int[np.ndarray, " k"], columns: Int[np.ndarray, " k"], random: np.random.Generator
    ) -> Float[np.ndarray, " k"]:
        """The depths (metres) of seed points near pixels in the image, with noise, in any range; inf where none is
        near."""
        cells = np.argwhere(np.isfinite(self.nearest))
        if not len(cells):
            return np.full(len(rows), np.inf)
        places = np.column_stack([rows, columns]) / COVERAGE_CELL - 0.5
        number = np.arange(1, min(NEAREST, len(cells)) + 1)
        distances, found = cKDTree(cells).query(places, number, distance_upper_bound=NEAR_CELLS)
        there = np.isfinite(distances)
        at = cells[np.where(there, found, 0)]
        farthest = np.where(there, self.nearest[at[..., 0], at[..., 1]], 0.0).max(axis=1)
        noise = np.exp(random.normal(0.0, SPREAD, len(rows)))
        return np.where(there.any(axis=1), farthest * noise, np.inf)


def uncovered(view: ColorView, points: Float[np.ndarray, "n 3"], ground_z: float) -> Uncovered:
    """A view's usable pixels in cells of COVERAGE_CELL pixels into which none of the world points projects.

    LiDAR reaches a few metres up facades and trees, and what it does not reach stands mostly above what it does. An
    upright surface has one depth in all rows of a level camera's column. Its depth is that of the nearest point in the
    next covered cell below, if this point is at least RAISED metres above the ground at height `ground_z`.
    """
    height, width = view.pixels.shape[:2]
    index, rows, columns, depths = in_image(
        view.where_seen(points), view.world_to_camera, view.intrinsics, (height, width)
    )
    raised = points[index, 2] > ground_z + RAISED
    shape = height // COVERAGE_CELL + 1, width // COVERAGE_CELL + 1
    nearest, nearest_raised = np.full(shape, np.inf), np.full(shape, np.inf)
    np.minimum.at(nearest, (rows // COVERAGE_CELL, columns // COVERAGE_CELL), depths)
    at_raised = rows[raised] // COVERAGE_CELL, columns[raised] // COVERAGE_CELL
    np.minimum.at(nearest_raised, at_raised, depths[raised])
    covered, upright = np.isfinite(nearest), np.where(nearest_raised <= nearest, nearest_raised, np.inf)
    for row in range(shape[0] - 2, -1, -1):
        upright[row] = np.where(covered[row], upright[row], upright[row + 1])
    filled = covered.repeat(COVERAGE_CELL, axis=0).repeat(COVERAGE_CELL, axis=1)[:height, :width]
    return Uncovered(np.flatnonzero(view.usable & ~filled), nearest, upright)


def far_points(
    view: ColorView,
    ground_z: float,
    candidates: Uncovered,
    count: int,
    depths: tuple[float, float],
    random: np.random.Generator,
    near: float = 0.0,
) -> tuple[np.ndarray, np.ndarray]:
    """At most `count` random points on the rays of pixels drawn from `candidates`.

    Their depth is that of something upright; otherwise, of a fraction `near` of them, that of seed points near in the
    image where there are any, and of the rest log-uniform between `depths` (metres). A point below the ground plane at
    height `ground_z` is moved along its ray onto the plane. Returns world positions (m, 3) and the colours (m, 3) uint8
    of the pixels.
    """
    chosen = random.choice(len(candidates.pixels), size=min(count, len(candidates.pixels)), replace=False)
    rows, columns = np.divmod(candidates.pixels[chosen], view.pixels.shape[1])
    camera_to_world = np.linalg.inv(view.world_to_camera)
    pixels = np.stack([columns + 0.5, rows + 0.5, np.ones(len(rows))], axis=1)
    rays = pixels @ np.linalg.inv(view.intrinsics).T @ camera_to_world[:3, :3].T
    center = camera_to_world[:3, 3]
    anywhere = np.exp(random.uniform(*np.log(depths), size=len(rows)))
    if near:
        beside = candidates.depths_near(rows, columns, random)
        anywhere = np.where((random.uniform(size=len(rows)) < near) & np.isfinite(beside), beside, anywhere)
    upright = candidates.upright[rows // COVERAGE_CELL, columns // COVERAGE_CELL]
    depth = np.where(np.isfinite(upright), upright, anywhere)
    with np.errstate(divide="ignore"):
        to_ground = np.where(rays[:, 2] < 0, (ground_z - center[2]) / rays[:, 2], np.inf)
    depth = np.minimum(depth, np.where(to_ground > 0, to_ground, np.inf))
    return center + depth[:, None] * rays, view.pixels[rows, columns]
