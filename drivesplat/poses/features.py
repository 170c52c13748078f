"""Features of images, outside of all that moves, and which of them are the same: a pycolmap database."""

from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.linalg import inv

from drivesplat.poses.rig import RigImages
from drivesplat.scene.ego_mask import EgoMask
from drivesplat.scene.images import continuous_intrinsics, read_image
from drivesplat.scene.rigid import inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.tracks import boxes_at
from drivesplat.settings.refine_poses import FeatureSettings, RefinePosesJob


def find_features(images: RigImages, job: RefinePosesJob, database: Path, threads: int) -> pycolmap.Reconstruction:
    """Writes the features of all images into a new database; returns the images with their given poses and features,
    and no points yet.

    Raises DatasetError where an image cannot be read.
    """

    def features(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        return _features(images, frame, job)

    with ThreadPoolExecutor(threads) as pool:
        return write_images(images, pool.map(features, images.frames), database)


def write_images(
    images: RigImages, found: Iterable[tuple[np.ndarray, np.ndarray]], database: Path
) -> pycolmap.Reconstruction:
    """Writes cameras, rig, and per image what was `found` (keypoints (n, 4), descriptors (n, 128)) into a new database;
    returns the same as a reconstruction without points."""
    reconstruction = pycolmap.Reconstruction()
    store = pycolmap.Database.open(database)
    for camera in images.pycolmap_cameras():
        store.write_camera(camera, use_camera_id=True)
        reconstruction.add_camera(camera)
    rig = images.rig()
    store.write_rig(rig, use_rig_id=True)
    reconstruction.add_rig(rig)
    for number, (frame, (keypoints, descriptors)) in enumerate(zip(images.frames, found, strict=True), start=1):
        image = pycolmap.Image(
            name=image_name(number),
            keypoints=keypoints[:, :2].astype(np.float64),
            camera_id=images.camera_id(frame),
            image_id=number,
        )
        store.write_image(image, use_image_id=True)
        store.write_frame(images.moment(number), use_frame_id=True)
        store.write_keypoints(number, keypoints)
        store.write_descriptors(number, pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, descriptors))
        reconstruction.add_frame(images.moment(number))
        image.frame_id = number
        reconstruction.add_image(image)
    store.close()
    return reconstruction


def match_features(images: RigImages, job: RefinePosesJob, database: Path, threads: int) -> None:
    """Matches features of images that may show the same, keeping what two views of one scene can explain."""
    pairs = database.parent / "pairs.txt"
    listed = image_pairs(images, job.refine_poses.features)
    pairs.write_text("".join(f"{image_name(a)} {image_name(b)}\n" for a, b in listed))
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = job.random_seed
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = pairs
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads)
    pycolmap.match_image_pairs(database, matching, pairing, verification, pycolmap.Device.cpu)


def image_name(number: int) -> str:
    """What pycolmap calls image `number`."""
    return f"{number:06d}"


def image_pairs(images: RigImages, settings: FeatureSettings) -> list[tuple[int, int]]:
    """Pairs of images (numbers from 1, the lesser first) that may show the same: neighbours of one camera, and images
    of cameras whose views overlap."""
    numbers = images.key_frames()
    pairs = {pair for camera in images.cameras for pair in _within(numbers[camera], settings.neighbours)}
    for a, b in combinations(images.cameras, 2):
        if views_overlap(images.first_of(a), images.first_of(b)):
            pairs.update(
                (min(i, j), max(i, j))
                for key, i in numbers[a].items()
                for other, j in numbers[b].items()
                if abs(key - other) <= settings.across
            )
    return sorted(pairs)


def _within(numbers: dict[int, int], reach: int) -> Iterator[tuple[int, int]]:
    keys = sorted(numbers)
    for position, key in enumerate(keys):
        for other in keys[position + 1 : position + 1 + reach]:
            yield min(numbers[key], numbers[other]), max(numbers[key], numbers[other])


def views_overlap(a: Frame, b: Frame) -> bool:
    """Whether two cameras of a rig look at some of the same things: by their headings and horizontal fields of view."""
    axes = [(inverse(frame.ego_to_world) @ frame.camera_to_world)[:2, 2] for frame in (a, b)]
    (ax, ay), (bx, by) = axes
    turn = np.arctan2(ax * by - ay * bx, ax * bx + ay * by)
    half_fields = sum(np.arctan(frame.width / 2 / frame.intrinsics[0, 0]) for frame in (a, b))
    return bool(abs(turn) < half_fields)


def shows_what_stands(
    scene: Scene, frame: Frame, pixels: np.ndarray, ego_mask: EgoMask, box_margin: float, every_box: bool = False
) -> np.ndarray:
    """Which pixels (n, 2), continuous, of a recorded image show neither a box that moves (`every_box`: any, as where no
    pose says which move), grown by `box_margin` metres, nor the own car: (n,) bool."""
    size = (frame.width, frame.height)
    columns, rows = (pixels[:, i].astype(int).clip(0, size[i] - 1) for i in (0, 1))
    stands = ~ego_mask.pixels(frame.camera, size)[rows, columns]
    in_camera = np.column_stack([pixels, np.ones(len(pixels))]) @ inv(continuous_intrinsics(frame, size)).T
    for box in boxes_at(scene, frame.timestamp):
        if box.moves or every_box:
            camera_to_object = inverse(box.object_to_world) @ frame.camera_to_world
            reach = box.size / 2 + box_margin
            stands &= ~meets_box(camera_to_object[:3, 3], in_camera @ camera_to_object[:3, :3].T, reach)
    return stands


def meets_box(origin: np.ndarray, directions: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Which rays (n,) bool from `origin` (3,) along `directions` (n, 3) meet the box from -`reach` to `reach` (3,), by
    the slab method."""
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.stack([(-reach - origin) / directions, (reach - origin) / directions])
    enters, leaves = np.nanmin(sides, axis=0).max(axis=1), np.nanmax(sides, axis=0).min(axis=1)
    return (enters <= leaves) & (leaves > 0)


def _features(images: RigImages, frame: Frame, job: RefinePosesJob) -> tuple[np.ndarray, np.ndarray]:
    """Keypoints (n, 4: x, y, scale, orientation) float32, x and y in continuous pixels of the recorded image, and
    descriptors (n, 128) uint8; those of the largest scale where there are too many."""
    settings = job.refine_poses.features
    reduction = min(1.0, settings.max_image_size / max(frame.width, frame.height))
    size = (round(frame.width * reduction), round(frame.height * reduction))
    grey = cv2.cvtColor(read_image(frame.image_path, size), cv2.COLOR_RGB2GRAY)
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, num_threads=1)
    options.sift.max_num_features = settings.max_features
    extractor = pycolmap.FeatureExtractor.create(options, pycolmap.Device.cpu)
    found, described = extractor.extract(pycolmap.Bitmap.from_array(grey))
    keypoints = np.asarray(pycolmap.keypoints_to_matrix(found), dtype=np.float32)
    keypoints[:, :2] *= np.array([frame.width, frame.height], dtype=np.float32) / size
    every_box = job.refine_poses.start == "images"
    stands = shows_what_stands(images.scene, frame, keypoints[:, :2], images.ego_mask, settings.box_margin, every_box)
    usable = np.flatnonzero(stands)
    kept = usable[largest(keypoints[usable], settings.max_features)]
    return keypoints[kept], np.ascontiguousarray(np.asarray(described.data)[kept])


def largest(keypoints: np.ndarray, count: int) -> np.ndarray:
    """The positions, increasing, of the `count` keypoints (n, 4: x, y, scale, orientation) of largest scale: pycolmap
    bounds their number only roughly, by whole levels of scale."""
    return np.sort(np.argsort(-keypoints[:, 2], kind="stable")[:count])
