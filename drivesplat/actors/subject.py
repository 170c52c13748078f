"""The vehicle that is looked at, and when: what moves and fills most pixels, or what the user named."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from drivesplat.errors import ConfigError
from drivesplat.parser import image_size
from drivesplat.regions import LABELS, REGIONS, Hull, hulls_in, label_of, owner_image
from drivesplat.scene import Frame, Scene
from drivesplat.settings.actor import SubjectSettings
from drivesplat.tracks import Box

MOVERS = REGIONS["moving_vehicle"]


@dataclass(frozen=True)
class Subject:
    """A vehicle in one image. `index` counts the scene's frames, and the parser record's images; `label` is one of
    `regions.LABELS`; `visible` (h, w) bool the pixels of its hull that no nearer box hides."""

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


def choose_subject(scene: Scene, parser: dict[str, Any], camera: str, settings: SubjectSettings) -> Subject | None:
    """The subject in the key frames of `camera` at training resolution; None where no vehicle moves before it.

    Raises ConfigError, saying what there is, where the settings name a track or a key frame that has no such vehicle.
    """
    best: Subject | None = None
    for subject in _candidates(scene, parser, camera, settings):
        if best is None or subject.pixels > best.pixels:
            best = subject
    if best is None and (settings.track is not None or settings.key_frame is not None):
        raise ConfigError(_nothing_there(scene, parser, camera, settings))
    return best


def _candidates(scene: Scene, parser: dict[str, Any], camera: str, settings: SubjectSettings) -> Iterator[Subject]:
    """Everything in the key frames asked for that may be looked at: what moves, or the track asked for."""
    for index, frame in enumerate(scene.frames):
        if frame.camera != camera or not frame.is_key_frame:
            continue
        if settings.key_frame is not None and frame.sample_index != settings.key_frame:
            continue
        size = image_size(parser, index)
        hulls = hulls_in(scene, frame, size)
        owners, covered = owner_image(hulls, size)
        for position, (hull, pixels) in enumerate(zip(hulls, covered, strict=True)):
            label = label_of(hull, pixels)
            wanted = label in MOVERS if settings.track is None else hull.box.track_id == settings.track
            visible = owners == position
            if wanted and visible.any():
                yield Subject(index, frame, hull, label, visible)


def _nothing_there(scene: Scene, parser: dict[str, Any], camera: str, settings: SubjectSettings) -> str:
    asked = " and ".join(f"{name} {value}" for name, value in settings if value is not None)
    anywhere: dict[str, list[int]] = {}
    for subject in _candidates(scene, parser, camera, SubjectSettings()):
        anywhere.setdefault(subject.box.track_id, []).append(subject.frame.sample_index)
    known = "; ".join(f"{track} in {min(frames)}-{max(frames)}" for track, frames in anywhere.items())
    return (
        f"subjects.{scene.name}: {camera} sees no vehicle that moves, or not the one asked for ({asked}); "
        f"what moves, with its first and last key frame: {known or 'nothing'}"
    )


def described(subject: Subject, scene: Scene, parser: dict[str, Any]) -> dict[str, Any]:
    """What the stages' JSON files say of their subject."""
    groups = [name for name, images in parser["splits"].items() if subject.index in images]
    box = subject.box
    return {
        "track": box.track_id,
        "category": box.category,
        "label": subject.label,
        "label_value": LABELS[subject.label],
        "key_frame": subject.frame.sample_index,
        "timestamp": subject.frame.timestamp,
        "image": parser["image_names"][subject.index],
        "split": groups[0] if groups else None,
        "distance_m": subject.hull.distance,
        "speed_m_s": box.speed,
        "size_m": box.size.tolist(),
        "pixels": subject.pixels,
        "origin": scene.origin.tolist(),
        "object_to_world": box.object_to_world.tolist(),
    }
