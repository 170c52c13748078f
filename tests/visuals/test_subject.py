"""The inspected vehicle and its key frame, compared with rays cast through every pixel at boxes in closed form."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from helpers.classed import classed
from helpers.hand_made import recording_of, write_labels

from drivesplat.errors import ConfigError
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import LABELS
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame, Scene, Track
from drivesplat.settings.visuals import SubjectSettings
from drivesplat.visuals.subject import choose_subject, subject_record

WIDTH = 192
"""Twice as wide as the tiny drive's images."""
ANY = SubjectSettings()


@dataclasses.dataclass(frozen=True)
class Actor:
    """A box that drives straight on: at `position` when the first key frame is taken, then with `velocity` (m/s)."""

    name: str
    position: tuple[float, float, float]
    velocity: tuple[float, float] = (0.0, 0.0)
    size: tuple[float, float, float] = (4.0, 2.0, 1.6)
    category: str = "vehicle.car"
    visibility: int = 4
    seen: range = range(10)

    def place(self, seconds: float) -> np.ndarray:
        return np.array(self.position) + seconds * np.array([*self.velocity, 0.0])

    def track(self, scene: Scene) -> Track:
        times, indices = scene.key_frame_timestamps[list(self.seen)], np.array(self.seen)
        places = [rigid(np.eye(3), self.place((time - scene.key_frame_timestamps[0]) * 1e-6)) for time in times]
        visibility = np.full(len(times), self.visibility)
        return Track(
            self.name, *classed(self.category), np.array(self.size), times, indices, np.stack(places), visibility
        )


def with_actors(scene: Scene, *actors: Actor) -> Scene:
    return dataclasses.replace(scene, tracks=tuple(actor.track(scene) for actor in actors))


def recorded(scene: Scene, width: int = WIDTH, masks: Path | None = None) -> EvaluationData:
    return recording_of(scene, masks, width, every_nth=4, offset=2, last_block=2)


def chosen(scene: Scene, settings: SubjectSettings = ANY, camera: str = "CAM_FRONT", width: int = WIDTH):
    return choose_subject(recorded(scene, width), camera, settings)


def seen_alone(frame: Frame, actor: Actor, seconds: float, width: int = WIDTH) -> np.ndarray:
    """The pixels (h, w) whose centres' rays meet the actor's box (slabs)."""
    scale = width / frame.width
    x, y = np.meshgrid((np.arange(width) + 0.5) / scale - 0.5, (np.arange(frame.height * scale) + 0.5) / scale - 0.5)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(frame.intrinsics).T
    rays = rays @ frame.camera_to_world[:3, :3].T
    start, half = frame.camera_to_world[:3, 3] - actor.place(seconds), np.array(actor.size) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-half - start) / rays, (half - start) / rays
    enter, leave = np.fmin(a, b).max(axis=-1), np.fmax(a, b).min(axis=-1)
    return (enter < leave) & (leave > 0)


def pixels_of(scene: Scene, *actors: Actor, width: int = WIDTH) -> dict[tuple[str, int], int]:
    """How many pixels each actor fills in each key frame where no box that is nearer hides it."""
    counts = {}
    for frame in (frame for frame in scene.frames if frame.is_key_frame):
        seconds = (frame.timestamp - scene.key_frame_timestamps[0]) * 1e-6
        there = [actor for actor in actors if frame.sample_index in actor.seen]
        away = [np.linalg.norm(actor.place(seconds) - frame.camera_to_world[:3, 3]) for actor in there]
        free = np.ones((frame.height * width // frame.width, width), dtype=bool)
        for i in np.argsort(away):
            own = seen_alone(frame, there[i], seconds, width)
            counts[there[i].name, frame.sample_index] = int((own & free).sum())
            free &= ~own
    return counts


def largest(counts: dict[tuple[str, int], int], *names: str) -> tuple[str, int]:
    return max((key for key in counts if key[0] in names), key=lambda key: counts[key])


def found(subject) -> tuple[str, int]:
    return subject.box.track_id, subject.frame.sample_index


LEADING = Actor("leading", (9.0, 0.3, 0.8), (4.2, 0.0))
ONCOMING = Actor("oncoming", (60.0, 4.0, 0.8), (-8.0, 0.0))
PARKED = Actor("parked", (11.0, -4.0, 1.3), size=(6.0, 2.4, 2.6), category="vehicle.truck")
WALKER = Actor("walker", (7.0, 2.0, 0.9), (4.0, 0.0), size=(0.8, 0.8, 1.8), category="human.pedestrian.adult")


@pytest.mark.parametrize(
    "actors",
    [
        pytest.param([LEADING, ONCOMING], id="two"),
        pytest.param([ONCOMING, LEADING, PARKED, WALKER], id="with what is no moving vehicle"),
        pytest.param([dataclasses.replace(LEADING, size=(1.8, 0.6, 1.2)), ONCOMING], id="nearest is not largest"),
        pytest.param([dataclasses.replace(LEADING, velocity=(2.0, 0.0))], id="nearer and nearer"),
        pytest.param([dataclasses.replace(LEADING, seen=range(3, 6))], id="there for a while"),
    ],
)
def test_the_moving_vehicle_with_the_most_pixels_is_chosen(tiny_scene, actors):
    scene = with_actors(tiny_scene, *actors)
    counts = pixels_of(scene, *actors)
    subject = chosen(scene)
    assert found(subject) == largest(counts, "leading", "oncoming")
    assert subject.pixels == pytest.approx(counts[found(subject)], abs=2)


def test_only_moving_vehicles_of_the_protocol_are_chosen(tiny_scene):
    """Not one that is slower than the threshold of motion, hardly visible, too far, too small, behind the camera, or
    beside or completely hidden in the image."""
    wall = Actor("wall", (7.0, 0.0, 1.5), (4.0, 0.0), size=(0.5, 7.0, 7.0), category="animal")
    changes = (
        {"velocity": (0.9, 0.0)}, {"visibility": 1}, {"position": (95.0, 0.0, 0.8)}, {"size": (0.3, 0.3, 0.3)},
        {"position": (-20.0, 0.0, 0.8)}, {"position": (9.0, 90.0, 0.8)},
    )  # fmt: skip
    others = ([dataclasses.replace(LEADING, **change)] for change in changes)
    for actors in ([], [PARKED], [WALKER], [LEADING, wall], *others):
        assert chosen(with_actors(tiny_scene, *actors)) is None, actors


def test_pixels_of_the_ego_mask_do_not_count(tiny_scene, tmp_path):
    """The ego vehicle's body fills the rows from 70 on, or all."""
    scene, settings = with_actors(tiny_scene, LEADING), SubjectSettings(key_frame=0)
    labels = np.full((108, WIDTH), LABELS["static"], dtype=np.uint8)
    labels[70:] = LABELS["own_car"]
    masks = write_labels(tmp_path / "part", scene, labels)
    free, subject = chosen(scene, settings), choose_subject(recorded(scene, masks=masks), "CAM_FRONT", settings)
    assert free.visible[70:].any() and free.visible[:70].any()
    np.testing.assert_array_equal(subject.visible[:70], free.visible[:70])
    assert not subject.visible[70:].any() and subject.pixels == free.visible[:70].sum()
    masks = write_labels(tmp_path / "whole", scene, np.full_like(labels, LABELS["own_car"]))
    assert choose_subject(recorded(scene, masks=masks), "CAM_FRONT", ANY) is None


def test_a_requested_track_is_chosen_at_its_largest_even_if_parked_or_at_a_requested_key_frame(tiny_scene):
    scene = with_actors(tiny_scene, LEADING, PARKED, ONCOMING)
    subject = chosen(scene, SubjectSettings(track="parked"))
    assert found(subject) == largest(pixels_of(scene, LEADING, PARKED, ONCOMING), "parked")
    assert subject.label == "parked_other_vehicle"
    assert found(chosen(scene, SubjectSettings(track="oncoming", key_frame=6))) == ("oncoming", 6)


@pytest.mark.parametrize(
    ("settings", "asked"),
    [
        pytest.param({"track": "nobody"}, ["track nobody"], id="no such track"),
        pytest.param({"key_frame": 40}, ["key_frame 40"], id="no such key frame"),
        pytest.param({"track": "late", "key_frame": 1}, ["track late", "key_frame 1"], id="it is not there then"),
        pytest.param({"track": "behind"}, ["track behind"], id="it is not before the camera"),
    ],
)
def test_a_missing_subject_is_refused_with_the_candidates(tiny_scene, settings, asked):
    late = dataclasses.replace(LEADING, name="late", position=(12.0, 2.5, 0.8), seen=range(4, 8))
    behind = dataclasses.replace(LEADING, name="behind", position=(-20.0, 0.0, 0.8))
    scene = with_actors(tiny_scene, LEADING, late, behind, PARKED)
    with pytest.raises(ConfigError) as refusal:
        chosen(scene, SubjectSettings(**settings))
    message = str(refusal.value)
    assert message.startswith(f"subjects.{scene.name}: CAM_FRONT")
    for words in (*asked, "leading in 0-9", "late in 4-7"):
        assert words in message
    known = message.split("last key frame:")[1]
    assert "behind" not in known and "parked" not in known


def test_without_moving_vehicles_a_request_is_refused(tiny_scene):
    with pytest.raises(ConfigError, match=r"key_frame 3.*: none$"):
        chosen(with_actors(tiny_scene, PARKED), SubjectSettings(key_frame=3, track="nobody"))


@pytest.mark.parametrize(("key_frame", "split"), [(0, "train"), (6, "interpolation"), (9, "extrapolation")])
def test_the_record_of_a_subject(tiny_scene, key_frame, split):
    actor = dataclasses.replace(LEADING, velocity=(4.0, 0.5))
    scene = with_actors(tiny_scene, actor)
    subject = chosen(scene, SubjectSettings(key_frame=key_frame))
    record = json.loads(json.dumps(subject_record(subject, recorded(scene)), allow_nan=False))
    frame = scene.frames[2 * key_frame]
    place = actor.place((frame.timestamp - scene.key_frame_timestamps[0]) * 1e-6)
    away = float(np.linalg.norm(place - frame.camera_to_world[:3, 3]))
    assert record.pop("distance_m") == pytest.approx(away)
    assert record.pop("speed_m_s") == pytest.approx(np.hypot(4.0, 0.5))
    np.testing.assert_allclose(record.pop("object_to_world"), rigid(np.eye(3), place), atol=1e-9)
    assert record == {
        "track": "leading", "category": "vehicle.car", "label": "moving_car", "label_value": LABELS["moving_car"],
        "key_frame": key_frame, "timestamp": frame.timestamp, "image": frame.image_path.rsplit("/", 1)[1],
        "split": split, "size_m": [4.0, 2.0, 1.6], "pixels": subject.pixels, "origin": scene.origin.tolist(),
    }  # fmt: skip
