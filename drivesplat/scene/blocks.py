"""Blocks of a long drive: stretches of its path, each of which is a scene of its own."""

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.spatial import cKDTree

from drivesplat.io.json_record import read_typed_json, write_typed_json
from drivesplat.io.storage import Provenance, no_provenance, read_record
from drivesplat.scene.scene import REFINED, Scene, read_scene
from drivesplat.settings.blocks import block_scene_name

SCHEMA = 1
RULE = "blocks"
MAX_SPEED, SLACK = 70.0, 5.0
"""A vehicle that moves by more than MAX_SPEED (m/s) and SLACK (m) between recordings has jumped."""


@dataclass(frozen=True)
class Block:
    """A stretch of a drive's path. The vehicle is in it during the `core` intervals [first, end) of microseconds; its
    scene has the recordings of the `used` intervals, which reach into the blocks before and after. `path` (n, 2) are
    places of the vehicle about a metre apart, in metres of the drive's world, and `digest` is that of its recordings.
    `previous` is the number of the block from which the vehicle comes into it for the first time, if the two share
    recordings: None for the first one, behind a jump, and without an overlap.
    """

    core: Int64[np.ndarray, "c 2"]
    used: Int64[np.ndarray, "u 2"]
    path: Float64[np.ndarray, "n 2"]
    digest: str = ""
    previous: int | None = None

    @property
    def origin(self) -> Float64[np.ndarray, "3"]:
        """The origin of its scene's world, in metres of the drive's world."""
        return np.append(self.path[0], 0.0)


@dataclass(frozen=True)
class Blocks:
    """All blocks of the drive `scene`, by number. Their cores divide its time. Block i is the scene `names[i]`. Blocks
    were cut by `length_m` metres (None: by an earlier version). `reason` says why where that length was chosen
    (`length_m: auto`), and is empty otherwise."""

    scene: str
    blocks: tuple[Block, ...]
    provenance: Provenance = field(default_factory=no_provenance)
    length_m: float | None = None
    reason: str = ""

    @property
    def names(self) -> list[str]:
        """The names of the blocks' scenes."""
        return [block_scene_name(self.scene, number) for number in range(len(self.blocks))]

    def at(self, timestamp: int) -> int:
        """The number of the block in which the vehicle is at a timestamp (microseconds); for one outside of the drive
        the first or the last interval's."""
        firsts = [(int(first), number) for number, block in enumerate(self.blocks) for first in block.core[:, 0]]
        before = [pair for pair in firsts if pair[0] <= timestamp]
        return max(before)[1] if before else min(firsts)[1]

    def without(self, left_out: Collection[int]) -> list[int]:
        """The numbers of the blocks, without those that are left out."""
        return [number for number in range(len(self.blocks)) if number not in left_out]

    def nearest(self, places: Float64[np.ndarray, "n 2"], left_out: Collection[int] = ()) -> Int64[np.ndarray, " n"]:
        """The number of the block whose path is nearest to each of some places in the drive's world (metres), of the
        blocks that are not left out."""
        numbers = self.without(left_out)
        paths = [self.blocks[number].path for number in numbers]
        owners = np.repeat(np.array(numbers), [len(path) for path in paths])
        return owners[cKDTree(np.concatenate(paths)).query(places)[1]]


def within(timestamps: Int64[np.ndarray, " n"], intervals: Int64[np.ndarray, "i 2"]) -> Bool[np.ndarray, " n"]:
    """Whether timestamps lie in any of some intervals [first, end)."""
    at = np.asarray(timestamps)[:, None]
    return ((at >= intervals[:, 0]) & (at < intervals[:, 1])).any(axis=1)


def jumped(times: Int64[np.ndarray, " n"], places: Float64[np.ndarray, "n 2"]) -> Bool[np.ndarray, " m"]:
    """Whether the vehicle jumps from each of its places (metres, at `times` in microseconds) to the next: m = n - 1."""
    moved, passed = np.linalg.norm(np.diff(places, axis=0), axis=1), np.diff(times) * 1e-6
    return moved > SLACK + MAX_SPEED * passed


def write_blocks(path: str | Path, blocks: Blocks) -> None:
    write_typed_json(path, blocks, SCHEMA)


def read_blocks(path: str | Path) -> Blocks:
    """Reads blocks.json. Raises ResultError that names the file and its rule if it is invalid.

    >>> blocks = read_blocks("results/commute/blocks.json")
    >>> blocks.names, blocks.at(1_532_402_927_647_951)
    (['commute.000', 'commute.001', 'commute.002'], 1)
    """
    return read_typed_json(path, RULE, Blocks, SCHEMA, "a record of blocks")


def drive_scene(results: Path, blocks: Blocks) -> Scene:
    """The record of a whole drive with the folder results/{scene}: that from which its `blocks` were cut, with refined
    poses where these were."""
    return read_scene(results / (REFINED if "refine_poses" in blocks.provenance.get("stages", ()) else "scene.json"))


def blocks_left_out(folder: Path) -> list[str]:
    """The names of the blocks that the figures of a drive leave out (`datasets.*.blocks.leave_out`), by the method's
    result folder of the drive; none before it is measured."""
    measured = folder / "eval.json"
    if not measured.is_file():
        return []
    return list(read_record(measured, "evaluate_blocks", "protocol")["protocol"].get("left_out", []))
