"""Mistakes in boxes, poses, clocks and cameras of a sound drive, and the sentence that each is warned of with."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest
from helpers import REPOSITORY
from helpers.drives import scene_at
from scipy.spatial.transform import Rotation

from drivesplat.readers.drive.check import whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.readers.drive_warnings import drive_warnings
from drivesplat.scene.rigid import inverse, rigid
from drivesplat.scene.scene import Scene, Track

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def sound(demo_root) -> Scene:
    """A synthetic drive of one camera."""
    return scene_at(demo_root, scene="demo", lidar_sweeps=True)


def of_tracks(scene: Scene, change: Callable[[Track], Track]) -> Scene:
    return dataclasses.replace(scene, tracks=tuple(map(change, scene.tracks)))


def posed(scene: Scene, pose: Callable[[Track, int, np.ndarray], np.ndarray]) -> Scene:
    """The scene with the pose (4, 4) of each track at each of its annotations changed."""
    return of_tracks(
        scene,
        lambda track: dataclasses.replace(
            track, object_to_world=np.stack([pose(track, i, p) for i, p in enumerate(track.object_to_world)])
        ),
    )


def sized(scene: Scene, size: Callable[[np.ndarray], np.ndarray]) -> Scene:
    return of_tracks(scene, lambda track: dataclasses.replace(track, size=size(track.size)))


def late(scene: Scene, seconds: float) -> Scene:
    return of_tracks(
        scene, lambda track: dataclasses.replace(track, timestamps=track.timestamps + round(seconds * 1e6))
    )


def w_last(pose: np.ndarray) -> np.ndarray:
    """A pose whose quaternion is written as x, y, z, w and read as w, x, y, z."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return rigid(Rotation.from_quat([y, z, w, x]).as_matrix(), pose[:3, 3])


def turned(pose: np.ndarray, degrees: float) -> np.ndarray:
    return pose @ rigid(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.zeros(3))


def raised(pose: np.ndarray, height: float) -> np.ndarray:
    return rigid(pose[:3, :3], pose[:3, 3] + [0.0, 0.0, height])


def in_frame(scene: Scene, frame: Callable[[int], np.ndarray]) -> Scene:
    """Tracks in a frame with a pose (4, 4) in the world at each time."""
    return posed(scene, lambda track, i, pose: inverse(frame(int(track.timestamps[i]))) @ pose)


def ego_at(scene: Scene, time: int) -> np.ndarray:
    return min(scene.frames, key=lambda frame: abs(frame.timestamp - time)).ego_to_world


def lidar_at(scene: Scene, time: int) -> np.ndarray:
    return min(scene.sweeps, key=lambda sweep: abs(sweep.timestamp - time)).sensor_to_world


TRACKS = {
    "w last": (lambda s: posed(s, lambda t, i, p: w_last(p)), "tracks: the z axes of"),
    "turned by 90 degrees": (lambda s: posed(s, lambda t, i, p: turned(p, 90)), "at 90 degrees to the x axis"),
    "turned by 180 degrees": (lambda s: posed(s, lambda t, i, p: turned(p, 180)), "at 180 degrees to the x axis"),
    "width first": (lambda s: sized(s, lambda size: size[[1, 0, 2]]), "tracks: length < width for"),
    "in feet": (lambda s: sized(s, lambda size: size * 3.28084), "tracks: boxes of class car are"),
    "half sizes": (lambda s: sized(s, lambda size: size / 2), "tracks: boxes of class car are"),
    "at the bottom": (lambda s: posed(s, lambda t, i, p: raised(p, -t.size[2] / 2)), "the floors of boxes lie 0.8"),
    "2 m above": (lambda s: posed(s, lambda t, i, p: raised(p, 2.0)), "tracks: the floors of boxes lie 2.0"),
    "ego frame": (lambda s: in_frame(s, lambda time: ego_at(s, time)), "to be in the ego frame"),
    "LiDAR frame": (lambda s: in_frame(s, lambda time: lidar_at(s, time)), "to be in the LiDAR frame"),
    "mirrored": (lambda s: posed(s, lambda t, i, p: MIRROR @ p @ MIRROR), "hardly a LiDAR return lies in boxes"),
    "0.25 s late": (lambda s: late(s, 0.25), "timestamps of tracks seem to be 0.25 s too late"),
    "0.5 s early": (lambda s: late(s, -0.5), "timestamps of tracks seem to be 0.50 s too early"),
}


def moved(scene: Scene, change: Callable[[np.ndarray, float], np.ndarray]) -> Scene:
    """The scene with another ego pose (4, 4) at each time (seconds), and all sensors mounted on it as before."""

    def shift(time: int) -> np.ndarray:
        ego = ego_at(scene, time)
        return change(ego, scene.seconds(time)) @ inverse(ego)

    frames = (
        dataclasses.replace(f, ego_to_world=m @ f.ego_to_world, camera_to_world=m @ f.camera_to_world)
        for f in scene.frames
        for m in [shift(f.timestamp)]
    )
    sweeps = (dataclasses.replace(s, sensor_to_world=shift(s.timestamp) @ s.sensor_to_world) for s in scene.sweeps)
    return dataclasses.replace(scene, frames=tuple(frames), sweeps=tuple(sweeps), tracks=())


def flat(ego: np.ndarray, seconds: float) -> np.ndarray:
    yaw = np.arctan2(ego[1, 0], ego[0, 0])
    return rigid(Rotation.from_euler("z", yaw).as_matrix(), ego[:3, 3] * [1.0, 1.0, 0.0])


POSES = {
    "z, roll and pitch 0": (lambda s: moved(s, flat), "disagree on the tilt of the ground by"),
    "z drifts": (
        lambda s: moved(s, lambda ego, seconds: raised(ego, 0.2 * seconds)),
        "disagree on the height of the ground by 0.20 m per second",
    ),
    "in feet": (
        lambda s: moved(s, lambda ego, seconds: rigid(ego[:3, :3], 3.28084 * ego[:3, 3])),
        "from each other on upright surfaces",
    ),
}


def of_frames(scene: Scene, change: Callable) -> Scene:
    return dataclasses.replace(scene, frames=tuple(dataclasses.replace(f, **change(f)) for f in scene.frames))


def mirrored(scene: Scene) -> Scene:
    """World and ego frame left-handed: all but the images, the mount of the camera and the LiDAR's points, whose frame
    is mirrored too."""
    frames = [MIRROR @ f.ego_to_world @ MIRROR for f in scene.frames]
    return dataclasses.replace(
        scene,
        tracks=(),
        frames=tuple(
            dataclasses.replace(f, ego_to_world=ego, camera_to_world=ego @ f.camera_to_ego)
            for f, ego in zip(scene.frames, frames, strict=True)
        ),
        sweeps=tuple(dataclasses.replace(s, sensor_to_world=MIRROR @ s.sensor_to_world) for s in scene.sweeps),
    )


LEFT = rigid(Rotation.from_euler("y", 3.0, degrees=True).as_matrix(), np.zeros(3))
LARGER = np.diag([4 / 3, 4 / 3, 1.0])
CAMERAS = {
    "of larger images": (
        lambda s: of_frames(s, lambda f: {"intrinsics": LARGER @ f.intrinsics}), "if K is multiplied by 0.75",
    ),
    "turned": (
        lambda s: of_frames(s, lambda f: {"camera_to_world": f.camera_to_world @ LEFT}),
        "turned by 3.0 degrees to the left",
    ),
    "mirrored drive": (mirrored, "if the drive is mirrored"),
}  # fmt: skip
MISTAKES = {
    f"{kind} {name}": mistake
    for kind, mistakes in (("tracks", TRACKS), ("poses", POSES), ("camera", CAMERAS))
    for name, mistake in mistakes.items()
}

ALIKE = {"tracks turned by 180 degrees", "tracks half sizes", "tracks 2 m above", "tracks 0.25 s late"}
"""Mistakes that differ from others in a number alone."""


def test_a_sound_drive_is_not_warned_of(sound):
    assert drive_warnings(sound) == []


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in ALIKE else name for name in MISTAKES]
)
def test_a_mistake_is_named_with_its_cause(name, sound, monkeypatch):
    if not name.startswith("camera"):  # the comparison of images takes most of the time
        monkeypatch.setattr(f"{drive_warnings.__module__}.image_warnings", lambda scene, sweeps: [])
    change, words = MISTAKES[name]
    found = drive_warnings(change(sound))
    assert any(words in sentence for sentence in found), found


SHARED = REPOSITORY.parent / "shared/data"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ddad-02", "nuscenes-sixcam-frame", "kitti-odometry-1", "kitti-0005-lidar"])
def test_recorded_drives_are_not_warned_of(name, tmp_path):
    folder = SHARED / name
    if not (folder / "drive.json").is_file():
        pytest.skip(f"no recorded drive at {folder}")
    assert drive_warnings(whole_scene(read_drive(folder), folder)) == []
    for other in (folder / "odometry", folder / "with_images"):
        if (other / "drive.json").is_file():
            assert drive_warnings(whole_scene(read_drive(other), other)) == []
