"""The stage `tracks`: the dynamic objects of a drive as a table, and as images with labels."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from drivesplat.io.storage import write_csv
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import MIN_PIXELS
from drivesplat.scene.tracks import box_at, ever_moves, short_ids
from drivesplat.settings.actor_seed import ActorSeedSettings
from drivesplat.trajectories.actor_record import read_actors
from drivesplat.visuals.figures import BOX, draw_outline, image_grid, show
from drivesplat.visuals.subject import Subject, visible_subjects

MAX_IMAGES = 6
TITLE = "moving objects, labelled with the start of their ids in tracks.csv"
DASHED = "; dashed: cannot be edited"
PARKED, CLASS, NO_METHOD, NEVER_SEEN = "parked", "class", "no method with actors", "never seen"
"""Reasons why a track cannot be edited: it does not move; `actors.classes` gives its class to the background; no method
of the config has actors; no training image shows it."""
DASHED_COLOR = "#e5e7eb"
"""The colour of the outlines of objects that cannot be edited."""
MIN_PIXEL_SHARE = 0.5
"""An image shows an object well if the object has at least this share of its maximum number of pixels there."""
LABEL_SHARE = np.array([0.11, 0.06])
"""Width and height of a label as shares of the image's, in figures of two columns."""


@dataclass(frozen=True)
class TrackRow:
    """A track in the table. `editable`: whether methods with actors represent it with Gaussians of its own.
    `seconds`: from its first annotation to its last; `seconds_visible`: how long it is visible to the evaluated
    camera; horizontal speeds in m/s; sizes in metres; `key_frame`: the one in which it has the most `pixels` of
    that camera's images, None and 0 if it is never visible. `not_editable`: PARKED, CLASS, NO_METHOD or NEVER_SEEN,
    empty for an editable track."""

    id: str
    category: str
    moves: bool
    editable: bool
    seconds: float
    seconds_visible: float
    speed_mean: float
    speed_max: float
    length: float
    width: float
    height: float
    key_frame: int | None
    pixels: int
    not_editable: str


SubjectsByImage = Mapping[int, Sequence[Subject]]
"""The visible dynamic objects in each key frame of the evaluated camera, by the index of the image."""


def subjects_by_image(recording: EvaluationData, camera: str) -> SubjectsByImage:
    """The visible dynamic objects in the key frames of `camera`."""
    return {index: visible_subjects(recording, index) for index in recording.scene.key_frames(camera)}


def editable_tracks(actors: Sequence[str]) -> set[str]:
    """The ids of the tracks in files of actors that become actors of a model."""
    records = (actor for path in actors for actor in read_actors(path).actors)
    return {actor.id for actor in records if len(actor.points)}


def track_rows(
    recording: EvaluationData,
    subjects: SubjectsByImage,
    editable: Collection[str],
    actors: ActorSeedSettings | None,
) -> list[TrackRow]:
    """A row per dynamic track: moving ones first, then by visible time. `editable`: the ids of editable tracks;
    `actors`: the settings that choose them, None if no method has actors."""
    by_track: dict[str, list[Subject]] = {}
    for subject in (subject for seen in subjects.values() for subject in seen):
        by_track.setdefault(subject.box.track_id, []).append(subject)
    rows, interval = [], recording.scene.key_frame_interval
    for track in recording.scene.tracks:
        if not track.object_class.is_dynamic:
            continue
        moves, seen = ever_moves(track), by_track.get(track.id, [])
        reason = ""
        if track.id not in editable and not moves:
            reason = PARKED
        elif track.id not in editable:
            reason = NO_METHOD if actors is None else NEVER_SEEN if actors.parts_of(track.object_class) else CLASS
        boxes = (box_at(track, int(time), interval) for time in track.timestamps)
        speeds = [box.speed for box in boxes if box is not None]
        largest = max(seen, key=lambda subject: subject.pixels, default=None)
        seconds = float(track.timestamps[-1] - track.timestamps[0]) * 1e-6
        row = TrackRow(
            id=track.id,
            category=track.category,
            moves=moves,
            editable=not reason,
            seconds=round(seconds, 2),
            seconds_visible=round(seconds * min(1.0, len(seen) / len(track.timestamps)), 2),
            speed_mean=round(float(np.mean(speeds)), 2),
            speed_max=round(float(np.max(speeds)), 2),
            **dict(zip(("length", "width", "height"), (round(float(s), 2) for s in track.size), strict=True)),
            key_frame=largest.frame.sample_index if largest else None,
            pixels=largest.pixels if largest else 0,
            not_editable=reason,
        )
        rows.append(row)
    return sorted(rows, key=lambda row: (not row.moves, -row.seconds_visible, -row.pixels, row.id))


def write_tracks(path: str | Path, rows: Sequence[TrackRow]) -> None:
    """Writes tracks.csv; missing values are empty cells."""
    write_csv(path, [field.name for field in fields(TrackRow)], map(asdict, rows))


def draw_tracks(recording: EvaluationData, subjects: SubjectsByImage, rows: Sequence[TrackRow], camera: str) -> Figure:
    """Few key frames that show every moving object well, at most MAX_IMAGES, with outlines and the starts of
    their ids; the outlines of those that cannot be edited are dashed. The middle key frame if nothing moves."""
    largest = {row.id: row.pixels for row in rows if row.moves and row.pixels >= MIN_PIXELS}
    moving = {
        i: [s for s in seen if s.box.track_id in largest and s.pixels >= MIN_PIXELS] for i, seen in subjects.items()
    }
    shown_well = {
        i: {s.box.track_id: s.pixels for s in seen if s.pixels >= MIN_PIXEL_SHARE * largest[s.box.track_id]}
        for i, seen in moving.items()
    }
    chosen = covering_images(shown_well) or [recording.scene.middle_key_frame(camera)]
    title = f"Scene {recording.scene.name}: " + (TITLE if largest else "nothing moves")
    editable = {row.id for row in rows if row.editable}
    title += DASHED if largest.keys() - editable else ""
    names = short_ids(list(largest))
    columns = min(2, len(chosen))
    height, width = recording.labels(chosen[0]).shape
    figure, axes = image_grid((height, width), rows=-(-len(chosen) // columns), columns=columns, title=title)
    for axis, index in zip(axes, chosen, strict=False):
        show(axis, recording.image(index), f"Key frame {recording.frame(index).sample_index}")
        taken: list[np.ndarray] = []
        for subject in moving[index]:
            name = subject.box.track_id
            color, line = (BOX, "solid") if name in editable else (DASHED_COLOR, "dashed")
            outline = draw_outline(axis, subject.hull.polygon, color, line)
            corner = np.clip(outline.min(axis=0), 0, [width * 0.9, height * 0.97])
            place, size = corner.copy(), LABEL_SHARE * [width, height]
            while any((np.abs(place - other) < size).all() for other in taken):  # above the other labels
                place[1] -= 0.25 * size[1]
            taken.append(place)
            box = {"facecolor": color, "edgecolor": "none", "pad": 1.5}
            arrow = {"arrowprops": {"arrowstyle": "-", "color": color}} if place[1] < corner[1] else {}
            axis.annotate(names[name], corner, place, fontsize=9, bbox=box, verticalalignment="bottom", **arrow)
    return figure


def covering_images(pixels: Mapping[int, Mapping[str, int]]) -> list[int]:
    """A greedy cover: the images, in order, that together show every id, at most MAX_IMAGES. `pixels`: per image the
    number of pixels of each id."""
    chosen: list[int] = []
    missing = {name for seen in pixels.values() for name in seen}
    while missing and len(chosen) < MAX_IMAGES:
        gains = {i: [seen[name] for name in seen if name in missing] for i, seen in pixels.items()}
        best = max(gains, key=lambda i: (len(gains[i]), sum(gains[i]), -i))
        chosen.append(best)
        missing -= pixels[best].keys()
    return sorted(chosen)
