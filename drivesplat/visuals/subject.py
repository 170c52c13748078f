"""The vehicle that is inspected, and its key frame: the largest moving one, or the one that the user named."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import LABELS, REGIONS, Hull, labelled_hulls
from drivesplat.scene.scene import Frame
from drivesplat.scene.tracks import Box
from drivesplat.settings.visuals import SubjectSettings

MOVING_VEHICLE_LABELS = REGIONS["moving_vehicle"]


@dataclass(frozen=True)
class Subject:
    """A vehicle in one image: `index` is that of the scene's frame and of the training record's image, `label` one of
    `regions.LABELS`, `visible` (h, w) bool the pixels of its hull not hidden by a nearer box or the ego vehicle."""

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
        """The number of its visible pixels."""
        return int(self.visible.sum())


def choose_subject(recording: EvaluationData, camera: str, settings: SubjectSettings) -> Subject | None:
    """The subject in the key frames of `camera` at training resolution; None if no moving vehicle is visible there.

    Raises ConfigError, listing the candidates, if the settings name a track or a key frame without such a vehicle.
    """
    best: Subject | None = None
    for subject in _candidates(recording, camera, settings):
        if best is None or subject.pixels > best.pixels:
            best = subject
    if best is None and (settings.track is not None or settings.key_frame is not None):
        requested = " and ".join(f"{name} {value}" for name, value in settings if value is not None)
        by_track: dict[str, list[int]] = {}
        for subject in _candidates(recording, camera, SubjectSettings()):
            by_track.setdefault(subject.box.track_id, []).append(subject.frame.sample_index)
        known = "; ".join(f"{track} in {min(frames)}-{max(frames)}" for track, frames in by_track.items())
        raise ConfigError(
            f"subjects.{recording.scene.name}: {camera} shows no vehicle that matches {requested}; "
            f"moving vehicles with their first and last key frame: {known or 'none'}"
        )
    return best


def visible_subjects(recording: EvaluationData, index: int) -> list[Subject]:
    """The visible annotated objects of dynamic classes in an image, farthest first."""
    frame, size = recording.frame(index), recording.size(index)
    hulls, owners, labels = labelled_hulls(recording.scene, frame, size)
    owners[recording.ego_mask(index)] = -1
    subjects = (
        Subject(index, frame, hull, label, owners == position)
        for position, (hull, label) in enumerate(zip(hulls, labels, strict=True))
    )
    return [subject for subject in subjects if subject.visible.any()]


def _candidates(recording: EvaluationData, camera: str, settings: SubjectSettings) -> Iterator[Subject]:
    """The candidates in the requested key frames: moving vehicles, or the requested track."""
    for index in recording.scene.key_frames(camera):
        if settings.key_frame not in (None, recording.frame(index).sample_index):
            continue
        for subject in visible_subjects(recording, index):
            if (
                subject.label in MOVING_VEHICLE_LABELS
                if settings.track is None
                else subject.box.track_id == settings.track
            ):
                yield subject


def no_subject_reason(camera: str) -> str:
    """Why a scene has no subject, for JSON files and titles."""
    return f"no moving vehicle is visible from {camera} in this scene"


def subject_record(subject: Subject, recording: EvaluationData) -> dict[str, Any]:
    """The subject in the stages' JSON files: metres, m/s, microseconds; `object_to_world` (4, 4) at the box centre."""
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
