"""Features of static content in images, and their matches, in a pycolmap database."""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.linalg import inv

from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.ego_mask import EgoMask
from drivesplat.scene.images import continuous_intrinsics, read_image
from drivesplat.scene.rigid import inverse, path_lengths
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.tracks import boxes_at
from drivesplat.settings.refine_poses import FeatureSettings, RefinePosesJob


def detect_features(images: RigImages, job: RefinePosesJob, database: Path, threads: int) -> pycolmap.Reconstruction:
    """Writes the features of all images to a new database. Returns images with given poses and features, no points.

    Raises DatasetError where an image cannot be read.
    """
    with ThreadPoolExecutor(threads) as pool:
        return write_images(images, pool.map(lambda frame: _detect(images, frame, job), images.frames), database)


def write_images(
    images: RigImages, features: Iterable[tuple[np.ndarray, np.ndarray]], database: Path
) -> pycolmap.Reconstruction:
    """Writes cameras, rig, and per image its keypoints (n, 4) and descriptors (n, 128) to a new database. Returns the
    same as a reconstruction without points."""
    reconstruction = pycolmap.Reconstruction()
    store = pycolmap.Database.open(database)
    for camera in images.pycolmap_cameras():
        store.write_camera(camera, use_camera_id=True)
        reconstruction.add_camera(camera)
    rig = images.rig()
    store.write_rig(rig, use_rig_id=True)
    reconstruction.add_rig(rig)
    for number, (frame, (keypoints, descriptors)) in enumerate(zip(images.frames, features, strict=True), start=1):
        image = pycolmap.Image(
            name=image_name(number),
            keypoints=keypoints[:, :2].astype(np.float64),
            camera_id=images.camera_id(frame),
            image_id=number,
        )
        store.write_image(image, use_image_id=True)
        store.write_frame(images.rig_frame(number), use_frame_id=True)
        store.write_keypoints(number, keypoints)
        store.write_descriptors(number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors))
        reconstruction.add_frame(images.rig_frame(number))
        image.frame_id = number
        reconstruction.add_image(image)
    store.close()
    return reconstruction


def match_features(images: RigImages, job: RefinePosesJob, database: Path, threads: int) -> None:
    """Matches features of `image_pairs`; matches that contradict the geometry of two views are dropped."""
    match_pairs(image_pairs(images, job.refine_poses.paired_features), job, database, threads)


def match_pairs(numbers: list[tuple[int, int]], job: RefinePosesJob, database: Path, threads: int) -> None:
    """Matches features of pairs of image numbers (from 1), as `match_features` does."""
    pairs = database.with_suffix(".pairs.txt")
    pairs.write_text("".join(f"{image_name(a)} {image_name(b)}\n" for a, b in numbers))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.random_seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads)
    pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)


def image_name(number: int) -> str:
    return f"{number:06d}"


def image_pairs(images: RigImages, settings: FeatureSettings) -> list[tuple[int, int]]:
    """Pairs of image numbers (from 1, the smaller first) to match: neighbours of one camera, and images of cameras
    whose views overlap."""
    numbers = images.key_frames()
    pairs: set[tuple[int, int]] = set()
    for by_key_frame in numbers.values():
        ordered = [by_key_frame[key] for key in sorted(by_key_frame)]
        for i, later in enumerate(later_images(images.ego_to_world[np.array(ordered) - 1], settings)):
            pairs.update((min(ordered[i], ordered[j]), max(ordered[i], ordered[j])) for j in later)
    for a, b in combinations(images.cameras, 2):
        if views_overlap(images.of_camera(a)[0], images.of_camera(b)[0]):
            pairs.update(
                (min(i, j), max(i, j))
                for key, i in numbers[a].items()
                for other, j in numbers[b].items()
                if abs(key - other) <= settings.across
            )
    return sorted(pairs)


def later_images(poses: np.ndarray, settings: FeatureSettings) -> list[list[int]]:
    """For each of a camera's images in the order of time, with the vehicle at `poses` (n, 4, 4): the later ones that it
    is matched with."""
    gone, found = path_lengths(poses), []
    for i in range(len(poses)):
        later = [i]
        for multiple in range(settings.neighbours):
            later.append(max(later[-1] + 1, int(np.searchsorted(gone, gone[i] + multiple * settings.spacing))))
        found.append([j for j in later[1:] if j < len(poses)])
    return found


def views_overlap(a: Frame, b: Frame) -> bool:
    """Whether the horizontal fields of view of two cameras of a rig overlap."""
    (ax, ay), (bx, by) = ((inverse(frame.ego_to_world) @ frame.camera_to_world)[:2, 2] for frame in (a, b))
    angle = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
    return bool(abs(angle) < sum(np.arctan(frame.width / 2 / frame.intrinsics[0, 0]) for frame in (a, b)))


def static_pixels(
    scene: Scene, frame: Frame, pixels: np.ndarray, ego_mask: EgoMask, box_margin: float, every_box: bool = False
) -> np.ndarray:
    """Which continuous pixels (n, 2) of a recorded image show neither the ego vehicle nor a moving box enlarged by
    `box_margin` metres: (n,) bool. `every_box`: exclude all boxes, for poses that do not say which move."""
    size = (frame.width, frame.height)
    columns, rows = (pixels[:, i].astype(int).clip(0, size[i] - 1) for i in (0, 1))
    static = ~ego_mask.pixels(frame.camera, size)[rows, columns]
    in_camera = np.column_stack([pixels, np.ones(len(pixels))]) @ inv(continuous_intrinsics(frame, size)).T
    for box in boxes_at(scene, frame.timestamp):
        if box.moves or every_box:
            camera_to_object = inverse(box.object_to_world) @ frame.camera_to_world
            half_size, directions = box.size / 2 + box_margin, in_camera @ camera_to_object[:3, :3].T
            static &= ~rays_hit_box(camera_to_object[:3, 3], directions, half_size)
    return static


def rays_hit_box(origin: np.ndarray, directions: np.ndarray, half_size: np.ndarray) -> np.ndarray:
    """Which rays (n,) bool from `origin` (3,) along `directions` (n, 3) hit the box from -`half_size` to `half_size`
    (3,), by the slab method."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack([(-half_size - origin) / directions, (half_size - origin) / directions])
    enter, leave = np.nanmin(sides, axis=0).max(axis=1), np.nanmax(sides, axis=0).min(axis=1)
    return (enter <= leave) & (leave > 0)


def _detect(images: RigImages, frame: Frame, job: RefinePosesJob) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (n, 4: x, y, scale, orientation) float32 in continuous pixels of the recorded image, and descriptors
    (n, 128) uint8. Beyond `max_features` those of the largest scale are kept."""
    settings = job.refine_poses.features
    reduction = min(1.0, settings.max_image_size / max(frame.width, frame.height))
    size = (round(frame.width * reduction), round(frame.height * reduction))
    grey = cv2.cvtColor(read_image(frame.image_path, size), cv2.COLOR_RGB2GRAY)
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features = settings.max_features
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    keypoint_list, descriptors = extractor.extract(pycolmap.Bitmap.from_array(grey))
    keypoints = np.asarray(pycolmap.keypoints_to_matrix(keypoint_list), dtype=np.float32)
    keypoints[:, :2] *= np.array([frame.width, frame.height], dtype=np.float32) / size
    every_box = job.refine_poses.start == "images"
    static = static_pixels(images.scene, frame, keypoints[:, :2], images.ego_mask, settings.box_margin, every_box)
    usable = np.flatnonzero(static)
    kept = usable[largest_scales(keypoints[usable], settings.max_features)]
    return keypoints[kept], np.ascontiguousarray(np.asarray(descriptors.data)[kept])


def largest_scales(keypoints: np.ndarray, count: int) -> np.ndarray:
    """Increasing indices of the `count` keypoints (n, 4: x, y, scale, orientation) of largest scale. pycolmap limits
    their number only approximately, by whole octaves."""
    return np.sort(np.argsort(-keypoints[:, 2], kind="stable")[:count])
