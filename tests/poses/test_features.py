"""Selection of image pairs, and of features on static content."""

import dataclasses

import numpy as np
import pytest
from helpers.classed import classed
from helpers.hand_made_views import HEADINGS, SIZE, drive_of, job_of
from PIL import Image

from drivesplat.preprocess.poses.features import (
    detect_features,
    image_pairs,
    largest_scales,
    rays_hit_box,
    static_pixels,
    views_overlap,
)
from drivesplat.preprocess.poses.rig import RigImages
from drivesplat.scene.ego_mask import NO_EGO_MASK, EgoMask
from drivesplat.scene.images import continuous_intrinsics, project
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene, Track
from drivesplat.settings.refine_poses import FeatureSettings, RefinePosesJob

CAMERAS = tuple(HEADINGS)
AROUND = drive_of(6, CAMERAS)


def pairs_of(scene: Scene, **settings) -> set[tuple[tuple[str, int], tuple[str, int]]]:
    """The pairs of images, as (camera, key frame) each."""
    images = RigImages.of(scene, range(len(scene.frames)))
    names = [(frame.camera, frame.sample_index) for frame in images.frames]
    listed = image_pairs(images, FeatureSettings(**settings))
    assert all(a < b for a, b in listed) and len(set(listed)) == len(listed)
    return {(names[a - 1], names[b - 1]) for a, b in listed}


def test_of_six_cameras_those_side_by_side_overlap():
    first = {frame.camera: frame for frame in AROUND.scene.frames[:6]}
    overlap = {frozenset((a, b)) for a in CAMERAS for b in CAMERAS if a != b and views_overlap(first[a], first[b])}
    around = zip(CAMERAS, (*CAMERAS[1:], CAMERAS[0]), strict=True)
    assert overlap == {frozenset(pair) for pair in around}


def test_neighbours_of_a_camera_are_matched_and_those_across():
    found = pairs_of(AROUND.scene, neighbours=2, across=1)
    front = {(a[1], b[1]) for a, b in found if a[0] == b[0] == "CAM_FRONT"}
    assert front == {(i, j) for i in range(6) for j in range(6) if 0 < j - i <= 2}
    beside = [{a, b} for a, b in found if {a[0], b[0]} == {"CAM_FRONT", "CAM_FRONT_LEFT"}]
    reach = [{("CAM_FRONT", i), ("CAM_FRONT_LEFT", j)} for i in range(6) for j in range(6) if abs(i - j) <= 1]
    assert len(beside) == len(reach) and all(pair in reach for pair in beside)
    assert not any({a[0], b[0]} == {"CAM_FRONT", "CAM_BACK"} for a, b in found)
    assert not any(a[0] != b[0] and a[1] != b[1] for a, b in pairs_of(AROUND.scene, across=0))


def brute(origin: np.ndarray, direction: np.ndarray, reach: np.ndarray) -> bool:
    """Whether any of many points along a ray lies in the box."""
    along = np.linspace(0.0, 40.0, 8001)[:, None] * direction / np.linalg.norm(direction)
    return bool((np.abs(origin + along) <= reach).all(axis=1).any())


def margin(origin: np.ndarray, direction: np.ndarray, reach: np.ndarray) -> bool:
    """Whether sampling can tell: a box slightly smaller and one slightly larger are met alike."""
    return brute(origin, direction, 0.97 * reach) == brute(origin, direction, 1.03 * reach)


@pytest.mark.parametrize(
    "origin", [(8.0, 1.0, 0.5), (0.3, -0.4, 0.2), (2.2, 0.0, 0.0), (0.0, 6.0, 0.0), (-5.0, -4.0, 3.0)],
    ids=["before", "inside", "beside, close", "beside", "diagonally"],
)  # fmt: skip
def test_rays_hit_a_box_where_points_along_them_lie_in_it(origin):
    origin, reach, rng = np.array(origin), np.array([2.0, 1.0, 0.8]), np.random.default_rng(0)
    towards = np.concatenate([rng.normal(size=(60, 3)), rng.uniform(-1.5, 1.5, (60, 3)) * reach - origin, np.eye(3),
                              -np.eye(3)])  # fmt: skip
    unambiguous = np.array([margin(origin, ray, reach) for ray in towards])
    expected = np.array([brute(origin, ray, reach) for ray in towards])
    assert unambiguous.sum() > 90 and expected.any()
    np.testing.assert_array_equal(rays_hit_box(origin, towards, reach)[unambiguous], expected[unambiguous])


def test_boxes_behind_the_camera_are_not_hit():
    rays = np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]])
    assert rays_hit_box(np.array([-5.0, 0.0, 0.0]), rays, np.ones(3)).tolist() == [True, False]


def car(speed: float, ahead: float = 12.0, category: str = "vehicle.car") -> Track:
    """A car ahead of the world's origin, along x."""
    times = np.array([0, 500_000, 1_000_000])
    poses = np.stack([rigid(np.eye(3), np.array([ahead + speed * time * 1e-6, 0.0, 0.8])) for time in times])
    return Track("it", *classed(category), np.array([4.0, 2.0, 1.6]), times, np.arange(3), poses, np.full(3, 4))


def static_of(
    track: Track | None, job: RefinePosesJob, camera: str = "CAM_FRONT", ego_mask: EgoMask = NO_EGO_MASK
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (n, 2) spread over the image of the first key frame, and which of them are static."""
    drive = drive_of(1, (camera,), ego_path=lambda _: np.eye(4), error=lambda _: np.eye(4))
    scene = dataclasses.replace(drive.scene, tracks=() if track is None else (track,))
    pixels = np.stack(np.meshgrid(np.arange(5.0, SIZE[0], 10.0), np.arange(5.0, SIZE[1], 10.0)), axis=-1).reshape(-1, 2)
    return pixels, static_pixels(scene, scene.frames[0], pixels, ego_mask, margin_of(job))


def margin_of(job: RefinePosesJob) -> float:
    return job.refine_poses.features.box_margin


def box_pixels(track: Track, margin: float) -> np.ndarray:
    """The least and the greatest pixel (2, 2) of its nearest face, which hides the rest from straight behind."""
    drive = drive_of(1, ego_path=lambda _: np.eye(4), error=lambda _: np.eye(4))
    frame, reach = drive.scene.frames[0], track.size / 2 + margin
    center = np.array([12.0 + 3.0 * frame.timestamp * 1e-6, 0.0, 0.8])
    face = center + np.array([[-1, y, z] for y in (-1, 1) for z in (-1, 1)]) * reach
    pixels, _ = project(face, inverse(frame.camera_to_world), continuous_intrinsics(frame, SIZE))
    return np.stack([pixels.min(axis=0), pixels.max(axis=0)])


@pytest.mark.parametrize("margin", [0.0, 0.3, 1.0])
def test_pixels_of_a_box_that_moves_are_left_out(margin):
    """The camera stands lower than the car's roof, right behind it: its face is all that is seen of the box."""
    job = job_of(features={"box_margin": margin})
    pixels, static = static_of(car(3.0), job)
    least, greatest = box_pixels(car(3.0), margin)
    inside = ((pixels > least) & (pixels < greatest)).all(axis=1)
    assert 50 < inside.sum() < 2000
    np.testing.assert_array_equal(static, ~inside)


def test_parked_cars_cars_behind_and_barriers_are_kept():
    for track in (car(0.0), car(3.0, ahead=-12.0), car(3.0, category="movable_object.barrier"), None):
        assert static_of(track, job_of())[1].all()


def test_a_camera_inside_a_moving_box_sees_nothing_static():
    assert not static_of(car(0.9, ahead=1.6, category="human.pedestrian.adult"), job_of())[1].any()


def test_the_ego_vehicle_is_left_out():
    outline = {"CAM_BACK": ((0.0, 0.8), (1.0, 0.8), (1.0, 1.0), (0.0, 1.0))}
    ego_mask = EgoMask({camera: (corners,) for camera, corners in outline.items()})
    pixels, static = static_of(None, job_of(), "CAM_BACK", ego_mask)
    clear = np.abs(pixels[:, 1] - 0.8 * SIZE[1]) > 2
    np.testing.assert_array_equal(static[clear], pixels[clear, 1] < 0.8 * SIZE[1])
    assert static_of(None, job_of(), ego_mask=ego_mask)[1].all()


def test_the_features_of_the_largest_scale_are_kept_in_their_order():
    keypoints = np.array([[0, 0, 2, 0], [1, 0, 5, 0], [2, 0, 1, 0], [3, 0, 5, 0], [4, 0, 3, 0]], dtype=np.float32)
    assert largest_scales(keypoints, 3).tolist() == [1, 3, 4]
    assert largest_scales(keypoints, 9).tolist() == [0, 1, 2, 3, 4]


@pytest.fixture(scope="module")
def dotted(tmp_path_factory):
    """Images with soft dots at known places, the same in each, of a drive with a moving car; and the places (n, 2)."""
    folder, size = tmp_path_factory.mktemp("dotted"), (320, 180)
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(np.arange(20, 310, 20), np.arange(20, 170, 20)), axis=-1).reshape(-1, 2)
    places = grid + rng.uniform(-3, 3, grid.shape)
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    radii = rng.uniform(2.0, 3.0, len(places))
    dots = sum(np.exp(-((x - px) ** 2 + (y - py) ** 2) / (2 * r**2)) for (px, py), r in zip(places, radii, strict=True))
    grey = (40 + 180 * np.minimum(dots, 1.0)).astype(np.uint8)
    Image.fromarray(np.repeat(grey[..., None], 3, axis=2)).save(folder / "dots.png")
    drive = drive_of(1, ego_path=lambda _: np.eye(4), error=lambda _: np.eye(4), size=size)
    frame = dataclasses.replace(drive.scene.frames[0], image_path=str(folder / "dots.png"))
    return dataclasses.replace(drive.scene, frames=(frame,), tracks=(car(3.0),)), places


@pytest.mark.parametrize("max_image_size", [1600, 200])
def test_features_lie_where_things_are_in_the_recorded_image_and_on_static_content(tmp_path, dotted, max_image_size):
    """Pixel centres included: a shift by half a pixel shows. A reduced image gives the same places."""
    scene, places = dotted
    job = job_of(features={"max_image_size": max_image_size})
    found = detect_features(RigImages.of(scene, [0]), job, tmp_path / "f.db", 1)
    pixels = np.stack([point.xy for point in found.images[1].points2D])
    still = static_pixels(scene, scene.frames[0], places, NO_EGO_MASK, margin_of(job))
    assert 5 < (~still).sum() < still.sum()
    apart = np.linalg.norm(pixels[:, None] - places, axis=2)
    near = apart.min(axis=1) < 1.5
    offsets = (pixels - places[apart.argmin(axis=1)])[near]
    assert near.sum() > 40 and (np.abs(np.median(offsets, axis=0)) < 0.15).all()
    assert static_pixels(scene, scene.frames[0], pixels, NO_EGO_MASK, margin_of(job)).all()
    inside = ((places > 30) & (places < np.array([290, 150]))).all(axis=1)
    assert (apart.min(axis=0)[still & inside] < 1.5).mean() > 0.8


def test_features_are_no_more_than_asked_for(tmp_path, dotted):
    scene, _ = dotted
    job = job_of(features={"max_features": 64})
    assert detect_features(RigImages.of(scene, [0]), job, tmp_path / "f.db", 1).images[1].num_points2D() == 64
