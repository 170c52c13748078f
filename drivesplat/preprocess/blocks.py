"""The stages `blocks` and `block`: cuts a long drive into blocks along its path, and makes the scene of each."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int, Int64
from scipy.spatial import cKDTree

from drivesplat.errors import DatasetError
from drivesplat.io.typed_record import field_values
from drivesplat.scene.blocks import Block, Blocks, jumped, within
from drivesplat.scene.scene import Frame, Scene, Sweep, Track
from drivesplat.settings.blocks import BlocksJob, CutSettings
from drivesplat.settings.images import HoldoutSettings

STEP = 1.0
"""Metres between the places of a path: smaller movements of a vehicle that stands count for nothing."""
MAX_AT_PLACE = 10
"""Key frames that a block keeps of a place at which the vehicle stands or crawls, beside those that are held out."""
MIN_TRAINED = 2
"""Key frames on the path of a block that it is trained on, at least: smaller blocks join others."""


def cut_into_blocks(scene: Scene, job: BlocksJob) -> Blocks:
    """The blocks of a drive. A part of the path is new, or one that the vehicle has driven before; new ones are cut by
    length, and the recordings of others belong to the blocks that they pass again. Where the vehicle jumps, as on a
    ferry, a block ends. `job.blocks.length_m` is in metres (`block_length.with_length`).

    Earlier blocks do not depend on how the drive goes on, unless it comes back to them.

    Raises DatasetError for a drive without poses.
    """
    whole, thinned = stretches(scene, job), without_crowds(scene, job.holdout)
    numbers = range(len(whole.blocks))
    digests = [_digest(_scene_of(thinned, whole, number, job.holdout)) for number in numbers]
    previous = [_previous(whole, block) for block in whole.blocks]
    known = zip(whole.blocks, digests, previous, strict=True)
    return replace(whole, blocks=tuple(replace(own, digest=digest, previous=before) for own, digest, before in known))


def stretches(scene: Scene, job: BlocksJob) -> Blocks:
    """`cut_into_blocks` without what is known of the recordings of blocks: `digest` and `previous`."""
    times, places = _ego_places(scene)
    anchors = _anchors(places)
    starts = times[anchors]
    owners = _owners(places[anchors], _jumps(times, places)[anchors], job.blocks)
    owners = _large_enough(owners, np.searchsorted(starts, _trained(scene, job.holdout), side="right") - 1)
    runs = [0, *(np.flatnonzero(np.diff(owners)) + 1).tolist(), len(owners)]
    first, last = _span(scene)
    starts[0] = first
    blocks = []
    for number in range(owners.max() + 1):
        own = [(a, b) for a, b in pairwise(runs) if owners[a] == number]
        core = np.array([[starts[a], starts[b] if b < len(starts) else last + 1] for a, b in own])
        used = _extended(own, times, places, anchors, job.blocks.overlap_m, core)
        blocks.append(Block(core, used, places[anchors[owners == number]]))
    return Blocks(scene.name, tuple(blocks), length_m=job.blocks.length_m)


def _previous(blocks: Blocks, block: Block) -> int | None:
    """See `Block.previous`."""
    before = int(block.core[0, 0]) - 1
    return blocks.at(before) if within(np.array([before]), block.used).any() else None


def block_scene(scene: Scene, blocks: Blocks, number: int, holdout: HoldoutSettings) -> Scene:
    """The scene of a block: its recordings, with key frames counted from 0 and the world's origin on its path. Held-out
    key frames are those of the whole drive; those of blocks beside it are excluded. Of a place at which the vehicle
    stands or crawls some key frames are kept.

    Raises DatasetError where the block has no key frame.
    """
    return _scene_of(without_crowds(scene, holdout), blocks, number, holdout)


def _scene_of(scene: Scene, blocks: Blocks, number: int, holdout: HoldoutSettings) -> Scene:
    """`block_scene`, of a scene `without_crowds`."""
    block, stamps = blocks.blocks[number], scene.key_frame_timestamps
    kept = _kept(scene, block)
    if len(kept) == 0:
        raise DatasetError(f"scene {blocks.names[number]}: the block has no key frame; make blocks longer (length_m)")
    own = np.flatnonzero(within(stamps, block.core))
    held_out: dict[str, list[int]] = {"excluded": []}
    for group, indices in holdout.held_out(len(stamps)).items():
        held_out[group] = np.searchsorted(kept, np.intersect1d(indices, own)).tolist()
        others = np.setdiff1d(np.intersect1d(indices, kept), own)
        held_out["excluded"] += np.searchsorted(kept, others).tolist()
    frames = tuple(_renumbered(frame, kept) for frame in _used(scene.frames, scene, block))
    sweeps = tuple(_renumbered(sweep, kept) for sweep in _used(scene.sweeps, scene, block))
    cameras, lidars = {frame.camera for frame in frames}, {sweep.lidar for sweep in sweeps}
    return _moved(
        replace(
            scene,
            name=blocks.names[number],
            description=f"block {number} of {scene.name}",
            key_frame_timestamps=stamps[kept],
            frames=frames,
            sweeps=sweeps,
            tracks=tuple(_tracks(scene, block, kept)),
            cameras=tuple(camera for camera in scene.cameras if camera.name in cameras),
            lidars=tuple(lidar for lidar in scene.lidars if lidar.name in lidars),
            key_frame_range=[int(kept[0]), int(kept[-1]) + 1] if len(kept) == kept[-1] - kept[0] + 1 else None,
            missing_images=0,
            held_out=held_out,
        ),
        block.origin,
    )


def without_crowds(scene: Scene, holdout: HoldoutSettings) -> Scene:
    """The scene without most of the recordings where the vehicle stands or crawls: at a place with more than
    MAX_AT_PLACE key frames so many of them stay, evenly in time, and those that are held out; nothing between them."""
    times, places = _ego_places(scene)
    starts, stamps = times[_anchors(places)], scene.key_frame_timestamps
    at = np.searchsorted(starts, stamps, side="right")
    held_out = {i for group in holdout.held_out(len(stamps)).values() for i in group}
    dropped: set[int] = set()
    crowded: set[int] = set()
    for place, count in zip(*np.unique(at, return_counts=True), strict=True):
        if count > MAX_AT_PLACE:
            indices = np.flatnonzero(at == place)
            kept = indices[np.linspace(0, count - 1, MAX_AT_PLACE).round().astype(int)]
            dropped |= {*indices.tolist()} - {*kept.tolist()} - held_out
            crowded.add(int(place))

    def stays(recording: Frame | Sweep) -> bool:
        if recording.is_key_frame:
            return recording.sample_index not in dropped
        return int(np.searchsorted(starts, recording.timestamp, side="right")) not in crowded

    return replace(
        scene,
        frames=tuple(frame for frame in scene.frames if stays(frame)),
        sweeps=tuple(sweep for sweep in scene.sweeps if stays(sweep)),
        tracks=tuple(_at_key_frames(track, ~np.isin(track.sample_indices, [*dropped])) for track in scene.tracks),
    )


def _at_key_frames(track: Track, chosen: np.ndarray) -> Track:
    """A track with some of its annotations, by mask."""
    return replace(
        track,
        timestamps=track.timestamps[chosen],
        sample_indices=track.sample_indices[chosen],
        object_to_world=track.object_to_world[chosen],
        visibility=track.visibility[chosen],
    )


def _kept(scene: Scene, block: Block) -> Int64[np.ndarray, " k"]:
    """The key frames of a block, of a scene without those that are dropped."""
    recorded = {recording.sample_index for recording in (*scene.frames, *scene.sweeps) if recording.is_key_frame}
    found = np.flatnonzero(within(scene.key_frame_timestamps, block.used))
    return found[np.isin(found, [*recorded])]


def _ego_places(scene: Scene) -> tuple[Int64[np.ndarray, " n"], Float64[np.ndarray, "n 2"]]:
    """The timestamps of images (of sweeps, without images), in order, and the places of the vehicle."""
    if scene.frames:
        found = {frame.timestamp: frame.ego_to_world[:2, 3] for frame in scene.frames}
    else:
        found = {sweep.timestamp: sweep.sensor_to_world[:2, 3] for sweep in scene.sweeps}
    times = np.array(sorted(found), dtype=np.int64)
    places = np.stack([found[time] for time in times.tolist()])
    if len(places) < 2 or not np.ptp(places, axis=0).any():
        raise DatasetError(f"scene {scene.name}: blocks follow the path of the vehicle, and it has none (poses)")
    return times, places


def _jumps(times: np.ndarray, places: np.ndarray) -> Int[np.ndarray, " n"]:
    """How often the vehicle has jumped up to each place."""
    return np.append(0, np.cumsum(jumped(times, places)))


def _anchors(places: np.ndarray) -> Int[np.ndarray, " a"]:
    """The first place, and each that lies STEP or more from the one before it."""
    found = [0]
    for i, place in enumerate(places):
        if np.linalg.norm(place - places[found[-1]]) >= STEP:
            found.append(i)
    return np.array(found)


def _arcs(places: np.ndarray) -> Float64[np.ndarray, " n"]:
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1)))


def _owners(places: np.ndarray, jumps: np.ndarray, settings: CutSettings) -> Int[np.ndarray, " a"]:
    """The number of the block of every anchor."""
    arcs = _arcs(places)
    before = _driven_before(places, arcs, settings)
    owners, count = np.full(len(places), -1), 0
    limits = np.flatnonzero((np.diff(before >= 0)) | (np.diff(jumps) > 0)) + 1
    for a, b in pairwise([0, *limits.tolist(), len(places)]):
        if before[a] >= 0:
            owners[a:b] = owners[before[a:b]]
            continue
        length = arcs[b - 1] - arcs[a]
        number = max(1, int(length / settings.length_m + 0.5))
        owners[a:b] = count + np.minimum((arcs[a:b] - arcs[a]) / settings.length_m, number - 1).astype(int)
        count += number
    return np.unique(owners, return_inverse=True)[1]  # a gap in the path may have left out some


def _trained(scene: Scene, holdout: HoldoutSettings) -> Int64[np.ndarray, " n"]:
    """The timestamps of key frames that are trained on."""
    held_out = [i for group in holdout.held_out(len(scene.key_frame_timestamps)).values() for i in group]
    return np.delete(scene.key_frame_timestamps, held_out)


def _large_enough(owners: Int[np.ndarray, " a"], trained: Int[np.ndarray, " n"]) -> Int[np.ndarray, " a"]:
    """The blocks of all anchors, where those with fewer than MIN_TRAINED of the key frames that are trained on, given
    by their anchors, join the block before or, at the start, behind them."""
    found = owners.copy()
    while True:
        counts = np.bincount(found[trained.clip(0)], minlength=found.max() + 1)
        small = np.flatnonzero(counts < MIN_TRAINED)
        if len(small) == 0 or found.max() == 0:
            return found
        own = np.flatnonzero(found == small[0])
        beside = found[own[0] - 1] if own[0] else found[np.flatnonzero(found != small[0])[0]]
        found[own] = beside
        found = np.unique(found, return_inverse=True)[1]


def _driven_before(places: np.ndarray, arcs: np.ndarray, settings: CutSettings) -> Int[np.ndarray, " a"]:
    """For anchors in a street that was driven before, the earliest anchor there; -1 for others. Passages shorter than
    the overlap count for nothing."""
    apart = 4.0 * settings.same_place_m
    near = cKDTree(places).query_ball_point(places, settings.same_place_m)
    found = np.full(len(places), -1)
    for i, others in enumerate(near):
        earlier = [j for j in others if arcs[i] - arcs[j] > apart]
        found[i] = min(earlier, default=-1)
    for again in (True, False):  # gaps between passages first, then short passages
        limits = [0, *(np.flatnonzero(np.diff(found >= 0)) + 1).tolist(), len(found)]
        for a, b in pairwise(limits):
            short = arcs[b - 1] - arcs[a] < max(settings.overlap_m, apart)
            if (found[a] < 0) == again and short and a > 0 and (b < len(found) or not again):
                found[a:b] = found[a - 1] if again else -1
    for i in np.flatnonzero(found >= 0):  # the first time of what was itself driven again
        if found[found[i]] >= 0:
            found[i] = found[found[i]]
    return found


def _extended(
    runs: list[tuple[int, int]],
    times: np.ndarray,
    places: np.ndarray,
    anchors: np.ndarray,
    overlap: float,
    core: np.ndarray,
) -> Int64[np.ndarray, "u 2"]:
    """The intervals of runs of anchors, and of the overlap before and after each, up to a jump."""
    arcs, jumps, starts = _arcs(places[anchors]), _jumps(times, places)[anchors], times[anchors]
    found: list[list[int]] = []
    for (a, b), (first, end) in zip(runs, core.tolist(), strict=True):
        before = np.flatnonzero((arcs[:a] > arcs[a] - overlap) & (jumps[:a] == jumps[a]))
        after = np.flatnonzero((arcs[b:] >= arcs[b - 1] + overlap) | (jumps[b:] != jumps[b - 1]))
        first = int(starts[before[0]]) if len(before) else first
        last = b + int(after[0]) if len(after) else len(starts)
        end = int(starts[last]) if last < len(starts) else int(max(end, times[-1] + 1))
        if found and first <= found[-1][1]:
            found[-1][1] = max(end, found[-1][1])
        else:
            found.append([first, end])
    return np.array(found, dtype=np.int64)


def _span(scene: Scene) -> tuple[int, int]:
    """The first and the last timestamp of a drive."""
    every = [recording.timestamp for recording in (*scene.frames, *scene.sweeps)]
    every += scene.key_frame_timestamps.tolist()
    return min(every), max(every)


def _used(recordings: tuple, scene: Scene, block: Block) -> Iterator:
    """The recordings of a block: those at key frames by the time of their key frame, others by their own."""
    return (recordings[i] for i in np.flatnonzero(within(block_stamps(recordings, scene), block.used)))


def block_stamps(recordings: Sequence[Frame | Sweep], scene: Scene) -> Int64[np.ndarray, " n"]:
    """The timestamps (microseconds) by which recordings belong to blocks."""
    stamps = [
        int(scene.key_frame_timestamps[one.sample_index]) if one.is_key_frame else one.timestamp for one in recordings
    ]
    return np.array(stamps, dtype=np.int64)


def _renumbered(recording: Frame | Sweep, kept: np.ndarray) -> Frame | Sweep:
    """A recording whose key frame is counted among those that are kept; the nearest one where its own is not."""
    nearest = int(np.argmin(np.abs(kept - recording.sample_index)))
    is_key_frame = recording.is_key_frame and kept[nearest] == recording.sample_index
    return replace(recording, sample_index=nearest, is_key_frame=bool(is_key_frame))


def _tracks(scene: Scene, block: Block, kept: np.ndarray) -> Iterator[Track]:
    """The tracks of a block's recordings."""
    for track in scene.tracks:
        own = within(track.timestamps, block.used) & np.isin(track.sample_indices, kept)
        if own.any():
            found = _at_key_frames(track, own)
            yield replace(found, sample_indices=np.searchsorted(kept, found.sample_indices))


def _moved(scene: Scene, origin: np.ndarray) -> Scene:
    """A scene whose world has its origin at a place (3,) of this one."""

    def moved(poses: np.ndarray) -> np.ndarray:
        found = poses.copy()
        found[..., :3, 3] -= origin
        return found

    return replace(
        scene,
        origin=scene.origin + origin,
        frames=tuple(
            replace(own, camera_to_world=moved(own.camera_to_world), ego_to_world=moved(own.ego_to_world))
            for own in scene.frames
        ),
        sweeps=tuple(replace(own, sensor_to_world=moved(own.sensor_to_world)) for own in scene.sweeps),
        tracks=tuple(replace(own, object_to_world=moved(own.object_to_world)) for own in scene.tracks),
    )


def _digest(scene: Scene) -> str:
    """That of a block's scene: of all but its provenance."""
    values = {name: value for name, value in field_values(scene).items() if name != "provenance"}
    return hashlib.blake2b(json.dumps(values, default=_plain).encode(), digest_size=16).hexdigest()


def _plain(value: object) -> object:
    return value.tolist() if isinstance(value, np.ndarray | np.integer) else field_values(value)
