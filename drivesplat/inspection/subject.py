"""The vehicle that is looked at, and when: what moves and fills most pixels, or what the user named."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.scene.prepared_drive import Recording
from drivesplat.scene.regions import LABELS, REGIONS, Hull, hulls_in, label_of, owner_image
from drivesplat.scene.scene import Frame
from drivesplat.scene.tracks import Box
from drivesplat.settings.inspection import SubjectSettings

MOVERS = REGIONS["moving_vehicle"]


@dataclass(frozen=True)
class Subject:
    """A vehicle in one image. `index` counts the scene's frames, and the training record's images; `label` is one of
    `regions.LABELS`; `visible` (h, w) bool the pixels of its hull that neither a nearer box nor the own car hides."""

    index: int
    frame: Frame
    hull: Hull
    label: str
    visible: np.ndarray

    @property
    def box(self) -> Box:
        return self.hull.box

    @property
    def pixels(self) -> int:
        """How many pixels it fills."""
        return int(self.visible.sum())


def choose_subject(recording: Recording, camera: str, settings: SubjectSettings) -> Subject | None:
    """The subject in the key frames of `camera` at training resolution; None where no vehicle moves before it.

    Raises ConfigError, saying what there is, where the settings name a track or a key frame that has no such vehicle.
    """
    best: Subject | None = None
    for subject in _candidates(recording, camera, settings):
        if best is None or subject.pixels > best.pixels:
            best = subject
    if best is None and (settings.track is not None or settings.key_frame is not None):
        raise ConfigError(_nothing_there(recording, camera, settings))
    return best


def seen_in(recording: Recording, index: int) -> list[Subject]:
    """Everything in an image that is annotated, can move and is to be seen, farthest first."""
    frame, size = recording.frame(index), recording.size(index)
    hulls = hulls_in(recording.scene, frame, size)
    owners, covered = owner_image(hulls, size)
    owners[recording.own_car(index)] = -1
    labels = (label_of(hull, pixels) for hull, pixels in zip(hulls, covered, strict=True))
    subjects = (
        Subject(index, frame, hull, label, owners == position)
        for position, (hull, label) in enumerate(zip(hulls, labels, strict=True))
    )
    return [subject for subject in subjects if subject.visible.any()]


def _candidates(recording: Recording, camera: str, settings: SubjectSettings) -> Iterator[Subject]:
    """Everything in the key frames asked for that may be looked at: what moves, or the track asked for."""
    for index in recording.scene.key_frames(camera):
        if settings.key_frame not in (None, recording.frame(index).sample_index):
            continue
        for subject in seen_in(recording, index):
            if subject.label in MOVERS if settings.track is None else subject.box.track_id == settings.track:
                yield subject


def _nothing_there(recording: Recording, camera: str, settings: SubjectSettings) -> str:
    asked = " and ".join(f"{name} {value}" for name, value in settings if value is not None)
    anywhere: dict[str, list[int]] = {}
    for subject in _candidates(recording, camera, SubjectSettings()):
        anywhere.setdefault(subject.box.track_id, []).append(subject.frame.sample_index)
    known = "; ".join(f"{track} in {min(frames)}-{max(frames)}" for track, frames in anywhere.items())
    return (
        f"subjects.{recording.scene.name}: {camera} sees no vehicle that moves, or not the one asked for ({asked}); "
        f"what moves, with its first and last key frame: {known or 'nothing'}"
    )


def described(subject: Subject, recording: Recording) -> dict[str, Any]:
    """What the stages' JSON files say of their subject."""
    box = subject.box
    return {
        "track": box.track_id,
        "category": box.category,
        "label": subject.label,
        "label_value": LABELS[subject.label],
        "key_frame": subject.frame.sample_index,
        "timestamp": subject.frame.timestamp,
        "image": recording.record.image_names[subject.index],
        "split": recording.split(subject.index),
        "distance_m": subject.hull.distance,
        "speed_m_s": box.speed,
        "size_m": box.size.tolist(),
        "pixels": subject.pixels,
        "origin": recording.scene.origin.tolist(),
        "object_to_world": box.object_to_world.tolist(),
    }
