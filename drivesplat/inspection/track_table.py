"""The stage `tracks`: what moves in a drive and can be named, as a table and as pictures with labels."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from drivesplat.inspection.figures import BOX, draw_outline, sheet, show
from drivesplat.inspection.subject import Subject, seen_in
from drivesplat.io.storage import write_csv
from drivesplat.scene.prepared_drive import Recording
from drivesplat.scene.regions import LEAST_PIXELS
from drivesplat.scene.scene import Track
from drivesplat.scene.tracks import beginnings, box_at, moves_at_all

MOST_PICTURES = 6
TITLE = "what moves, by the beginning of its id (tracks.csv)"
WELL_SEEN = 0.5
"""A mover is well seen where it fills at least this share of the pixels that it fills where it fills most."""
NARROW = 0.06
"""The labels of boxes narrower than this share of the image stand aslant."""


@dataclass(frozen=True)
class TrackRow:
    """A track in the table. `seconds`: from its first annotation to its last; `seconds_visible`: in how much of that
    the evaluated camera sees it; speeds in m/s, horizontal; sizes in metres; `key_frame`: where it fills most `pixels`
    of that camera's images, None and 0 where it is never seen."""

    id: str
    category: str
    moves: bool
    seconds: float
    seconds_visible: float
    speed_mean: float
    speed_max: float
    length: float
    width: float
    height: float
    key_frame: int | None
    pixels: int


Sightings = Mapping[int, Sequence[Subject]]
"""What is seen in each key frame of the evaluated camera, by the number of the image."""


def sightings_of(recording: Recording, camera: str) -> Sightings:
    """Everything that can move in the key frames of `camera`."""
    return {index: seen_in(recording, index) for index in recording.scene.key_frames(camera)}


def track_rows(recording: Recording, sightings: Sightings) -> list[TrackRow]:
    """A row per track that can move: what moves first, then what is seen longest."""
    by_track: dict[str, list[Subject]] = {}
    for subject in (subject for seen in sightings.values() for subject in seen):
        by_track.setdefault(subject.box.track_id, []).append(subject)
    interval = recording.scene.key_frame_interval
    tracks = [track for track in recording.scene.tracks if track.object_class.is_dynamic]
    rows = [_row(track, by_track.get(track.id, []), interval) for track in tracks]
    return sorted(rows, key=lambda row: (not row.moves, -row.seconds_visible, -row.pixels, row.id))


def _row(track: Track, seen: list[Subject], interval: float) -> TrackRow:
    boxes = (box_at(track, int(time), interval) for time in track.timestamps)
    speeds = [box.speed for box in boxes if box is not None]
    largest = max(seen, key=lambda subject: subject.pixels, default=None)
    seconds = float(track.timestamps[-1] - track.timestamps[0]) * 1e-6
    return TrackRow(
        id=track.id,
        category=track.category,
        moves=moves_at_all(track),
        seconds=round(seconds, 2),
        seconds_visible=round(seconds * min(1.0, len(seen) / len(track.timestamps)), 2),
        speed_mean=round(float(np.mean(speeds)), 2),
        speed_max=round(float(np.max(speeds)), 2),
        **dict(zip(("length", "width", "height"), (round(float(s), 2) for s in track.size), strict=True)),
        key_frame=largest.frame.sample_index if largest else None,
        pixels=largest.pixels if largest else 0,
    )


def write_tracks(path: str | Path, rows: Sequence[TrackRow]) -> None:
    """Writes tracks.csv; an empty cell where there is no value."""
    write_csv(path, [field.name for field in fields(TrackRow)], map(asdict, rows))


def draw_tracks(recording: Recording, sightings: Sightings, rows: Sequence[TrackRow], camera: str) -> Figure:
    """As few key frames as show every mover well, at most MOST_PICTURES, with the movers outlined and the beginnings of
    their ids beside them; the middle key frame where nothing moves."""
    largest = {row.id: row.pixels for row in rows if row.moves and row.pixels >= LEAST_PIXELS}
    movers = {
        i: [s for s in seen if s.box.track_id in largest and s.pixels >= LEAST_PIXELS] for i, seen in sightings.items()
    }
    well = {
        i: {s.box.track_id: s.pixels for s in seen if s.pixels >= WELL_SEEN * largest[s.box.track_id]}
        for i, seen in movers.items()
    }
    chosen = fewest_that_show_all(well) or [recording.scene.middle_key_frame(camera)]
    title = f"Scene {recording.scene.name}: " + (TITLE if largest else "nothing moves")
    names = beginnings(list(largest))
    columns = min(2, len(chosen))
    shape = recording.labels(chosen[0]).shape
    figure, axes = sheet(shape, rows=-(-len(chosen) // columns), columns=columns, title=title)
    for axis, index in zip(axes, chosen, strict=False):
        show(axis, recording.image(index), f"Key frame {recording.frame(index).sample_index}")
        for subject in movers[index]:
            _label(axis, subject, names[subject.box.track_id], shape)
    return figure


def fewest_that_show_all(pixels: Mapping[int, Mapping[str, int]]) -> list[int]:
    """The images, in order, that together show all that any shows, at most MOST_PICTURES; greedily, those first that
    show most that is not shown yet. `pixels`: per image how many pixels each id fills."""
    chosen: list[int] = []
    missing = {name for seen in pixels.values() for name in seen}
    while missing and len(chosen) < MOST_PICTURES:
        gains = {i: [seen[name] for name in seen if name in missing] for i, seen in pixels.items()}
        best = max(gains, key=lambda i: (len(gains[i]), sum(gains[i]), -i))
        chosen.append(best)
        missing -= pixels[best].keys()
    return sorted(chosen)


def _label(axis: Axes, subject: Subject, name: str, shape: tuple[int, ...]) -> None:
    outline = draw_outline(axis, subject.hull.polygon)
    x, y = np.clip(outline.min(axis=0), 0, [shape[1] * 0.9, shape[0] * 0.97])
    box = {"facecolor": BOX, "edgecolor": "none", "pad": 1.5}
    narrow = np.ptp(outline[:, 0]) < NARROW * shape[1]  # its neighbours' labels would cover each other
    turn = {"rotation": 40 if narrow else 0, "rotation_mode": "anchor", "verticalalignment": "bottom"}
    axis.text(x, y, name, fontsize=9, bbox=box, **turn)
