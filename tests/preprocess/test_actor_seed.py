"""Selection of actors and their initial points: LiDAR in the actor's frame, coloured by training images only."""

import dataclasses
import pickle

import numpy as np
import pytest
from helpers import drives
from helpers.drives import (
    CAMERA_AT,
    HELD_OUT,
    LIDAR_AT,
    NOTHING_HELD_OUT,
    TRAINING,
    Thing,
    World,
    cast_lidar,
    drive,
    seconds_of,
    shows,
)
from helpers.records import write_invalid
from PIL import Image

from drivesplat.errors import ResultError
from drivesplat.io.array_file import write_arrays
from drivesplat.io.storage import no_provenance
from drivesplat.io.typed_record import field_values
from drivesplat.preprocess.actor_seed import actors_record
from drivesplat.scene.object_class import ObjectClass
from drivesplat.scene.scene import Frame, Scene, Track
from drivesplat.scene.splits import frame_groups
from drivesplat.settings.actor_seed import ActorSeedJob, ActorSeedSettings
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.trajectories.actor_record import ActorRecord, ActorRecords, read_actors
from drivesplat.trajectories.motion import Motion

CAR = World().things[0]
"""A car ahead of the ego vehicle: 4 x 2 x 1.6 m, its rear initially 4.8 m from the camera."""
FLOOR = 0.1


def job(holdout=HELD_OUT, width=None, random_seed=0, radius=2.5, **settings) -> ActorSeedJob:
    """Settings without random points by default."""
    return ActorSeedJob(
        actors=ActorSeedSettings(**{"min_points": 0, **settings}),
        holdout=HoldoutSettings(**holdout),
        images=ImageSettings(width=width),
        own_car_radius=radius,
        random_seed=random_seed,
    )


def actors_of(scene: Scene, settings: ActorSeedJob) -> list[ActorRecord]:
    return actors_record(scene, settings).actors


def the_actor(scene: Scene, settings: ActorSeedJob) -> ActorRecord:
    (actor,) = actors_of(scene, settings)
    return actor


def contents(record: ActorRecords) -> list[bytes]:
    """The fields of the actors bit for bit, including motions."""
    fields = (sorted((vars(one) | {"motion": None} | field_values(one.motion)).items()) for one in record.actors)
    return [pickle.dumps(value) for actor in fields for value in actor]


def returns_of(world: World, thing: Thing, key_frames, margin=0.1, radius=2.5) -> np.ndarray:
    """The LiDAR returns (n, 3) of the key frames that lie in a thing's box, in its frame, which is the world's but for
    its place; from the drive's geometry."""
    gathered, half = [], np.array(thing.size) / 2
    for seconds in (0.5 * index for index in key_frames):
        sensor = cast_lidar(world, seconds)[:, :3].astype(float)
        sensor = sensor[np.hypot(sensor[:, 0], sensor[:, 1]) > radius]
        offsets = sensor + world.ego_at(seconds) + LIDAR_AT - thing.at(seconds)
        inside = (np.abs(offsets[:, :2]) < half[:2] + margin).all(axis=1) & (offsets[:, 2] < half[2] + margin)
        gathered.append(offsets[inside & (offsets[:, 2] > FLOOR - half[2])])
    return np.concatenate(gathered)


@pytest.mark.parametrize("radius", [2.5, 6.3])
def test_points_are_exactly_the_training_returns_in_the_box_in_its_frame(tiny_scene, tmp_path, radius):
    """Ego vehicle, road and held-out sweeps are all left out, and so are sweeps that are missing or corrupt. The car
    ahead is 5.6 m from the LiDAR, so a radius of 6.3 m cuts it."""
    actor = the_actor(tiny_scene, job(radius=radius))
    expected = returns_of(World(), CAR, TRAINING, radius=radius)
    assert 30 < len(expected) < len(returns_of(World(), CAR, range(10), radius=radius))
    assert actor.category == "vehicle.car" and actor.size.tolist() == [4.0, 2.0, 1.6]
    assert actor.lidar_points == len(actor.points) == len(actor.points_rgb)
    np.testing.assert_allclose(actor.points, expected, atol=1e-4)
    (tmp_path / "corrupt.pcd.bin").write_bytes(b"no sweep")
    sweeps = list(tiny_scene.sweeps)
    for index, name in ((1, "missing.pcd.bin"), (3, "corrupt.pcd.bin")):
        sweeps[index] = dataclasses.replace(sweeps[index], path=str(tmp_path / name))
    actor = the_actor(dataclasses.replace(tiny_scene, sweeps=tuple(sweeps)), job(radius=radius))
    np.testing.assert_allclose(actor.points, returns_of(World(), CAR, (0, 4, 5, 7), radius=radius), atol=1e-4)


def test_few_lidar_points_are_complemented_by_random_points_in_the_box(tiny_scene):
    lidar = the_actor(tiny_scene, job()).points
    actor = the_actor(tiny_scene, job(min_points=len(lidar) + 1, random_points=4000))
    assert (actor.lidar_points, len(actor.points)) == (len(lidar), 4000)
    np.testing.assert_array_equal(actor.points[: len(lidar)], lidar)
    share = actor.points[len(lidar) :] / actor.size + 0.5
    assert share.min() >= 0.0 and share.max() <= 1.0
    for axis in range(3):
        np.testing.assert_allclose(np.quantile(share[:, axis], [0.25, 0.5, 0.75]), [0.25, 0.5, 0.75], atol=0.04)
    assert np.abs(np.corrcoef(share.T)[[0, 0, 1], [1, 2, 2]]).max() < 0.06


def raised(scene: Scene, metres: float) -> Scene:
    """The scene with its cars as trucks whose boxes are higher by some metres: no return is near their roofs."""

    def as_high(track: Track) -> Track:
        poses = track.object_to_world.copy()
        poses[:, 2, 3] += metres / 2
        size = track.size + np.array([0.0, 0.0, metres])
        return dataclasses.replace(track, object_class=ObjectClass.TRUCK, size=size, object_to_world=poses)

    tracks = (as_high(track) if track.object_class is ObjectClass.CAR else track for track in scene.tracks)
    return dataclasses.replace(scene, tracks=tuple(tracks))


def test_the_sides_and_the_roof_of_a_truck_above_its_returns_have_points(tiny_scene):
    lidar = the_actor(tiny_scene, job()).lidar_points
    low, high = (the_actor(raised(tiny_scene, metres), job(random_points=3000)) for metres in (0.2, 0.8))
    assert len(low.points) == low.lidar_points == lidar, "the roof of a vehicle is often a little lower than its box"
    assert high.lidar_points == lidar
    above, half = high.points[lidar:].astype(float), high.size / 2
    returns = np.quantile(high.points[:lidar, 2], 0.98)
    assert len(above) == pytest.approx(3000 * (half[2] - returns) / high.size[2], abs=1)
    assert returns <= above[:, 2].min() < returns + 0.1 and above[:, 2].max() == pytest.approx(half[2])
    on_face = np.isclose(np.abs(above), half, atol=1e-5)
    on_face[:, 2] &= above[:, 2] > 0
    assert on_face.any(axis=1).all()
    left, right = ((on_face & (sign * above > 0)).mean(axis=0)[:2] for sign in (1.0, -1.0))
    np.testing.assert_allclose(left, right, atol=0.05)
    assert on_face.mean(axis=0).min() > 0.05, "two sides, two ends and the roof"


def car(x: float, y: float = 0.0, speed: float = 4.0, **more) -> Thing:
    return Thing("vehicle.car", (4.0, 1.8, 1.5), (x, y, 0.75), (speed, 0.0), **more)


PARKED, FAR = car(12.0, -4.0, 0.0), car(35.0)
HIDING = Thing("vehicle.truck", (4.0, 2.4, 2.6), (9.0, 0.0, 1.3), (4.0, 0.0))


@pytest.mark.parametrize(
    ("things", "expected", "unseen"),
    [
        pytest.param([CAR], 1, 0, id="ahead"),
        pytest.param([PARKED], 0, 0, id="parked"),
        pytest.param([car(-12.0)], 0, 1, id="behind"),
        pytest.param([FAR], 0, 1, id="far"),
        pytest.param([car(17.0)], 1, 0, id="not hidden"),
        pytest.param([HIDING, car(17.0)], 1, 1, id="hidden"),
        pytest.param([car(9.0, -3.5, seen=range(2, 4))], 0, 1, id="held out"),
        pytest.param([car(9.0, -3.5, seen=range(1, 4))], 1, 0, id="partly held out"),
        pytest.param([World().things[3]], 0, 0, id="none"),
    ],
)
def test_actors_are_dynamic_vehicles_that_a_training_image_sees(tmp_path, caplog, things, expected, unseen):
    scene = drive(tmp_path, *things, width=192, height=108, key_frames=4)
    caplog.set_level("INFO")
    found = [actor.id for actor in actors_record(scene, job()).actors]
    skipped = [line for line in caplog.messages if "no training image shows" in line]
    assert (len(found), len(skipped)) == (expected, unseen)
    assert not any(actor in line for actor in found for line in skipped)
    assert all(any(track.id in line for track in scene.tracks) for line in skipped)


def test_visibility_depends_on_the_image_size(tmp_path):
    scene = drive(tmp_path, FAR, width=384, height=216, key_frames=3)
    assert [len(actors_of(scene, job(width=width))) for width in (None, 96)] == [1, 0]


RIDERS = [
    Thing(category, (1.8, 0.7, 1.6), (9.0, y, 0.8), (3.0, 0.0))
    for category, y in (
        ("vehicle.bicycle", -3.0), ("vehicle.motorcycle", -1.0), ("human.pedestrian.adult", 1.0),
        ("vehicle.bus.rigid", 3.0), ("animal", 4.0), ("movable_object.pushable_pullable", 5.0),
    )
]  # fmt: skip


def test_settings_say_whether_cycles_and_people_become_actors(tmp_path):
    scene = drive(tmp_path, *RIDERS, key_frames=4)
    for settings, expected in (
        ({}, ["bicycle", "motorcycle", "rigid"]),
        ({"cycles": False, "humans": True}, ["adult", "rigid"]),
    ):
        found = actors_of(scene, job(**settings))
        assert sorted(actor.category.split(".")[-1] for actor in found) == expected


def painted(scene: Scene, color_of) -> None:
    """Replaces every image of a scene by `color_of(frame)` (h, w, 3), stored losslessly as PNG."""
    for frame in scene.frames:
        image = np.broadcast_to(np.asarray(color_of(frame), dtype=np.uint8), (frame.height, frame.width, 3))
        Image.fromarray(np.ascontiguousarray(image)).save(frame.image_path, format="PNG")


def pixels_of(world: World, thing: Thing, frame: Frame, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows (n, 2) of points (n, 3) in a thing's frame, which is the world's but for its place, as a frame
    shows them, and their distances (n,) from the camera."""
    seconds = seconds_of(frame.timestamp)
    away = points + thing.at(seconds) - world.ego_at(seconds) - CAMERA_AT
    in_camera = np.stack([-away[:, 1], -away[:, 2], away[:, 0]], axis=1) / away[:, :1]
    return np.floor((in_camera @ world.intrinsics.T)[:, :2] + 0.5).astype(int), np.linalg.norm(away, axis=1)


def inside(pixels: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Whether pixels (n, 2) lie in an image, and in its mask (h, w)."""
    there = (pixels >= 0).all(axis=1) & (pixels < mask.shape[::-1]).all(axis=1)
    there[there] = mask[pixels[there, 1], pixels[there, 0]]
    return there


@pytest.mark.parametrize("speed", [CAR.velocity[0], 3.0], ids=["away", "near"])
def test_a_point_has_the_colour_of_its_nearest_training_camera_that_sees_the_actor_there(tmp_path, speed):
    """Every image has a grey of its own. The ego vehicle falls back, or approaches the car at 1 m/s."""
    thing = dataclasses.replace(CAR, velocity=(speed, 0.0))
    world, scene = World(things=[thing]), drive(tmp_path, thing)
    painted(scene, lambda frame: (2 * scene.frames.index(frame) + 10,) * 3)
    actor = the_actor(scene, job(min_points=10**6, random_points=2000))
    points, expected = actor.points.astype(float), np.full(2000, -1)
    best = np.full(2000, np.inf)
    groups = frame_groups(scene, job().holdout)
    for number, (frame, group) in enumerate(zip(scene.frames, groups, strict=True)):
        pixels, distances = pixels_of(world, thing, frame, points)
        better = inside(pixels, shows(world, frame, thing)) & (distances < best) & (group == "train")
        best[better], expected[better] = distances[better], 2 * number + 10
    shown = expected >= 0
    assert shown.sum() > 1000 and len(np.unique(expected)) > 1
    np.testing.assert_array_equal(actor.points_rgb[shown], np.repeat(expected[shown, None], 3, axis=1))
    np.testing.assert_array_equal(actor.points_rgb[~shown], round(expected[shown].mean()))


def test_the_record_holds_the_tracks_own_motion_in_the_models_seconds(tmp_path):
    """A track with a gap. Seconds count from the first image, 35 ms before the first key frame."""
    speeding = Thing("vehicle.car", (4.0, 2.0, 1.6), (10.0, 0.0, 0.8), (2.0, 0.0), gain=(1.0, 0.0))
    scene = drive(tmp_path, speeding)
    (track,) = scene.tracks
    kept = [0, 1, 2, 5, 6, 7, 8, 9]
    fields = ("timestamps", "sample_indices", "object_to_world", "visibility")
    track = dataclasses.replace(track, **{name: getattr(track, name)[kept] for name in fields})
    scene = dataclasses.replace(scene, tracks=(track,))
    actor, expected = the_actor(scene, job()), Motion.of_track(scene, track)
    motion = actor.motion
    assert actor.id == track.id and (motion.runs, motion.reach) == (((0, 2), (3, 7)), 0.25)
    np.testing.assert_allclose(motion.times, 0.035 + 0.5 * np.array(kept), atol=1e-9)
    places = [speeding.at(0.5 * i)[0] for i in kept]
    np.testing.assert_allclose(motion.object_to_world[:, 0, 3], places, atol=1e-6)
    at = np.linspace(-0.5, 6.0, 40)
    np.testing.assert_allclose(motion.poses(at), expected.poses(at), atol=1e-9)  # smoothing keeps a straight line
    np.testing.assert_array_equal(motion.present(at), expected.present(at))


def test_occluders_do_not_colour_an_actor(tmp_path):
    """A walker hides the same part of the car in every image. Images are red in the walker's box and blue elsewhere;
    points behind the walker get the mean colour of the others."""
    walker = Thing("human.pedestrian.adult", (0.6, 0.6, 1.9), (5.5, 0.3, 0.95), (4.2, 0.0))
    scene, world = drive(tmp_path, walker, CAR), World(things=[walker, CAR])
    masks = {frame.token: shows(world, frame, walker) for frame in scene.frames}
    painted(scene, lambda frame: np.where(masks[frame.token][..., None], (255, 0, 0), (0, 0, 255)))
    actor = the_actor(scene, job(min_points=10**6, random_points=2000))
    assert actor.category == "vehicle.car"
    pixels, _ = pixels_of(world, CAR, scene.frames[0], actor.points.astype(float))
    assert inside(pixels, masks[scene.frames[0].token]).sum() > 100
    np.testing.assert_array_equal(actor.points_rgb, np.broadcast_to([0, 0, 255], (2000, 3)))


def test_held_out_images_and_sweeps_contribute_nothing(tiny_scene, spoilt):
    """Held-out images become magenta and held-out sweeps garbage in the car's box: not a bit changes."""
    changes = {"width": 64, "min_points": 10**6, "random_points": 1000, "humans": True}
    settings = job(**changes)
    garbage = np.random.default_rng(0).uniform([5.6, -1.0, -1.5, 0, 0], [9.6, 1.0, -0.3, 0, 0], (500, 5))
    scene, before = spoilt(settings.holdout, garbage), actors_record(tiny_scene, settings)
    assert len(before.actors) == 2 and contents(actors_record(scene, settings)) == contents(before)
    found = actors_of(scene, job(NOTHING_HELD_OUT, **changes))[0]
    assert len(found.points) > 1500, "the garbage lies in its box"


def test_each_actor_names_the_parts_that_can_represent_it(tmp_path):
    walker = Thing("human.pedestrian.adult", (0.6, 0.6, 1.9), (8.0, 0.0, 0.95), (4.2, 0.0))
    rider = Thing("vehicle.bicycle", (1.8, 0.6, 1.9), (8.0, 2.0, 0.95), (4.2, 0.0))
    classes = {"pedestrian": "deformable", "bicycle": ("deformable", "actors")}
    scene = drive(tmp_path, CAR, walker, rider)
    found = {actor.category: actor for actor in actors_of(scene, job(classes=classes))}
    assert {category: actor.parts for category, actor in found.items()} == {
        "vehicle.car": ("actors",),
        "human.pedestrian.adult": ("deformable",),
        "vehicle.bicycle": ("deformable", "actors"),
    }
    for category, rigid, deforming in (
        ("vehicle.car", "actors", "actors"), ("human.pedestrian.adult", None, "deformable"),
        ("vehicle.bicycle", "actors", "deformable"),
    ):  # fmt: skip
        assert found[category].part_in(("background", "actors")) == rigid
        assert found[category].part_in(("background", "actors", "deformable")) == deforming


@pytest.mark.parametrize(
    "content",
    [None, b"", b"text", [], {}, {"actors": []},
     *({"actors": actors, "provenance": no_provenance()} for actors in (None, ["x"], [{"id": "x"}]))],
    ids=str,
)  # fmt: skip
def test_an_invalid_record_is_named_with_its_rule_and_an_empty_one_is_read(tmp_path, content):
    path = tmp_path / "actors.npz"
    write_invalid(path, content)
    with pytest.raises(ResultError, match=r"actors\.npz: .*the rule 'actors' rebuilds it"):
        read_actors(path)
    write_arrays(path, ActorRecords([]))
    assert read_actors(path).actors == []


@pytest.mark.slow
def test_visible_dynamic_vehicles_of_the_real_scene_become_actors(real_scene_root):
    scene = drives.scene_at(real_scene_root, dataset="nuscenes", scene="0061", sweeps=False)
    found = actors_of(scene, job({}, min_points=2000))
    assert 4 <= len(found) <= 7 and all(actor.category.startswith("vehicle.") for actor in found)
    for actor in found:
        assert len(actor.points) == 8000 and actor.lidar_points < 100, "all but one of its sweeps are missing"
        assert len(np.unique(actor.points_rgb, axis=0)) > 50


@pytest.mark.parametrize("smoothed", [True, False])
def test_annotations_that_wander_are_smoothed_where_wanted(smoothed, tmp_path):
    scene = drive(tmp_path, Thing("vehicle.car", (4.0, 2.0, 1.6), (10.0, 0.0, 0.8), (2.0, 0.0), gain=(1.0, 0.0)))
    (track,) = scene.tracks
    poses = track.object_to_world.copy()
    poses[::2, 2, 3] += 0.1
    scene = dataclasses.replace(scene, tracks=(dataclasses.replace(track, object_to_world=poses),))
    heights = the_actor(scene, job(smoothed=smoothed)).motion.object_to_world[:, 2, 3]
    assert (np.ptp(heights[2:-2]) < 0.03) == smoothed
