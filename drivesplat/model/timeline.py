"""The annotated state of all actors at one time, as tensors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation
from torch import Tensor

from drivesplat.trajectories.motion import Motion

MAX_CACHED_TIMES = 16384
"""Number of times whose states are cached. A training reuses those of its images, 1,440 for six cameras at 12 Hz over
20 s, and with a rolling shutter two more for each. A state of 30 actors with 40 annotations each takes 6 kB, the full
cache 100 MB."""

BEND_STEP = 0.5
"""Seconds over which second differences of corrections are penalised, the interval of nuScenes' annotations. At other
rates the penalty scales as a second derivative does, so that corrections are smooth over the same time."""
MIN_STEP = 0.05
"""Seconds between annotations below which the penalty grows no more."""


@dataclass(frozen=True)
class ActorTrack:
    """The track that owns a set of Gaussians: `size` (3,) length, width, height in metres, the annotated motion, and
    the class, an `ObjectClass`."""

    id: str
    size: Float[np.ndarray, "3"]
    motion: Motion
    object_class: str = "vehicle"


class TimeState(NamedTuple):
    """The state at one time of a actors with m annotations in all.

    `quats` (w, x, y, z) and `translations` (metres) are the annotated object to world; `weights` the interpolation
    weight of each annotation in its actor's position; `series` cos(i pi t / T), t running from 0 to T over an actor's
    annotations; `walked` the length (metres) of an actor's horizontal path since its first annotation; `side` 1, or -1
    for an actor that is mirrored about the plane through its x and z axes.
    """

    quats: Float[Tensor, "a 4"]
    translations: Float[Tensor, "a 3"]
    present: Bool[Tensor, " a"]
    weights: Float[Tensor, " m"]
    series: Float[Tensor, "a f"]
    walked: Float[Tensor, " a"]
    side: Float[Tensor, " a"]


class Timeline:
    """The annotations of all actors, one track after the other; `terms` is the length of `TimeState.series`."""

    def __init__(self, tracks: Sequence[ActorTrack], terms: int):
        self.tracks = tuple(tracks)
        self._terms = terms
        self._cache: dict[tuple[float, torch.device], TimeState] = {}

    @property
    def owned(self) -> list[slice]:
        """The slice of the m annotations of each track."""
        ends = np.cumsum([len(track.motion.times) for track in self.tracks]).tolist()
        return [slice(start, end) for start, end in zip([0, *ends], ends, strict=False)]

    @property
    def actor_of_annotations(self) -> Int[Tensor, " m"]:
        counts = torch.tensor([len(track.motion.times) for track in self.tracks])
        return torch.repeat_interleave(torch.arange(len(counts)), counts)

    @property
    def of_actors(self) -> Bool[Tensor, "a m"]:
        """The mask of annotations of each actor."""
        return torch.arange(len(self.tracks))[:, None] == self.actor_of_annotations

    @property
    def neighbours(self) -> Int[Tensor, "q 3"]:
        """All triples of consecutive annotations without a gap."""
        triples = [
            [own.start + i - 1, own.start + i, own.start + i + 1]
            for track, own in zip(self.tracks, self.owned, strict=True)
            for first, last in track.motion.runs
            for i in range(first + 1, last)
        ]
        return torch.tensor(triples, dtype=torch.long).reshape(-1, 3)

    @property
    def bend_scale(self) -> float:
        """What makes squared second differences of corrections independent of the annotation rate: they count as over
        BEND_STEP seconds. The median over `neighbours`; 1 for annotations at 2 Hz."""
        times = torch.cat([torch.from_numpy(track.motion.times) for track in self.tracks])[self.neighbours]
        steps = ((times[:, 2] - times[:, 0]) / 2.0).clamp(min=MIN_STEP)
        return float((BEND_STEP / steps).pow(4).median()) if len(steps) else 1.0

    def corrected(self, shifts: Float[np.ndarray, "m 3"], turns: Float[np.ndarray, " m"]) -> list[Motion]:
        """The motion of each track with corrections of its annotations: metres along the world's axes, and radians
        about the object's vertical axis."""
        motions = []
        for track, own in zip(self.tracks, self.owned, strict=True):
            poses = track.motion.object_to_world.copy()
            poses[:, :3, 3] += shifts[own]
            motions.append(replace(track.motion, object_to_world=poses, turns=turns[own]))
        return motions

    def at(self, time: float, device: torch.device) -> TimeState:
        """The state at a time in seconds since the scene's first image."""
        if (time, device) not in self._cache:
            self.precompute([time], device)
        return self._cache[time, device]

    def precompute(self, times: Sequence[float], device: torch.device) -> None:
        """Computes and caches the states at many times together, which takes hardly longer than one."""
        times = [time for time in dict.fromkeys(times) if (time, device) not in self._cache]
        for i in range(0, len(times), MAX_CACHED_TIMES):
            batch = times[i : i + MAX_CACHED_TIMES]
            for time, state in zip(batch, self._states(np.array(batch), device), strict=True):
                self._cache[time, device] = state
        while len(self._cache) > MAX_CACHED_TIMES:
            del self._cache[next(iter(self._cache))]

    def _states(self, at: np.ndarray, device: torch.device) -> list[TimeState]:
        """The states at the seconds `at` (n,)."""
        shape, owned = (len(at), len(self.tracks)), self.owned
        weights, poses = np.zeros((len(at), owned[-1].stop)), np.tile(np.eye(4), (*shape, 1, 1))
        present, progress, walked = np.zeros(shape, dtype=bool), np.zeros(shape), np.zeros(shape)
        for i, (track, own) in enumerate(zip(self.tracks, owned, strict=True)):
            motion = track.motion
            there = present[:, i] = motion.present(at)
            if there.any():
                weights[there, own], poses[there, i] = motion.weights(at[there]), motion.poses(at[there])
            walked[:, i] = motion.walked(at)
            progress[:, i] = np.clip((at - motion.times[0]) / (np.ptp(motion.times) or np.inf), 0.0, 1.0)
        series = np.cos(np.pi * progress[..., None] * np.arange(self._terms))
        quats = Rotation.from_matrix(poses[..., :3, :3].reshape(-1, 3, 3)).as_quat(scalar_first=True)
        values = (quats.reshape(*shape, 4), poses[..., :3, 3], present, weights, series, walked, np.ones(shape))
        tensors = (torch.from_numpy(value if value.dtype == bool else value.astype(np.float32)) for value in values)
        return [TimeState(*each) for each in zip(*(tensor.to(device).unbind() for tensor in tensors), strict=True)]
