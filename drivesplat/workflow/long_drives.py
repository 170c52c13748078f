"""Drives that are cut into blocks: which scenes they become, and the files that blocks and drives are made from."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.io.storage import canonical_json, sha256_text
from drivesplat.settings.blocks import block_scene_name, drive_of
from drivesplat.workflow.outputs import Outputs


class LongDrives:
    """The drives of a `plan` that are cut into blocks. `blocks_file` gives the blocks.json of a drive by its name, or
    lets Snakemake make it and ask again."""

    def __init__(self, plan: Outputs, blocks_file: Callable[[str], str]):
        self._plan, self._blocks_file = plan, blocks_file
        self._read: dict[str, list[dict[str, Any]]] = {}

    def of_block(self, wildcards: Any) -> list[str]:
        """The scene of a block's drive, and its blocks.json. Raises ConfigError for a block that the drive lacks."""
        drive = drive_of(wildcards.scene)
        file = self._blocks_file(drive)
        self._number(wildcards.scene)
        return [self._plan.annotated_scene(_Named(drive)), file]

    def digest(self, wildcards: Any) -> str:
        """That of a block's recordings: a block whose recordings are the same is not made again, however the drive goes
        on."""
        return str(self._block(wildcards.scene)["digest"])

    def own_checkpoints(self, wildcards: Any) -> list[str]:
        """The trainings of a block and of those beside it, by number."""
        names = [block_scene_name(drive_of(wildcards.scene), number) for number in self._joined(wildcards.scene)]
        return [f"{self._plan.config.results_dir}/{name}/{wildcards.method}/own/checkpoint.npz" for name in names]

    def joined_digest(self, wildcards: Any) -> str:
        """That of the paths of these blocks."""
        blocks = self._blocks(drive_of(wildcards.scene))
        return sha256_text(canonical_json({i: blocks[i]["path"] for i in self._joined(wildcards.scene)}))

    def results(self, name: str) -> Callable[[Any], list[str]]:
        """The function of wildcards that gives the result `name` of every block of a drive, in order. In it, '{method}'
        is the method of the job."""

        def of_blocks(wildcards: Any) -> list[str]:
            self._blocks_file(wildcards.scene)
            folder, own = self._plan.config.results_dir, name.format(method=getattr(wildcards, "method", ""))
            count = len(self._blocks(wildcards.scene))
            return [f"{folder}/{block_scene_name(wildcards.scene, number)}/{own}" for number in range(count)]

        return of_blocks

    def _joined(self, scene: str) -> Sequence[int]:
        """The numbers of a block and of those beside it."""
        blocks, own = self._blocks(drive_of(scene)), self._number(scene)
        return [i for i in range(len(blocks)) if i == own or _beside(blocks[own], blocks[i])]

    def _number(self, scene: str) -> int:
        drive, number = drive_of(scene), int(scene.rpartition(".")[2])
        count = len(self._blocks(drive))
        if number >= count:
            raise ConfigError(
                f"scene {drive} has no block {number}; it has {count}: {block_scene_name(drive, 0)} to "
                f"{block_scene_name(drive, count - 1)}"
            )
        return number

    def _block(self, scene: str) -> dict[str, Any]:
        return self._blocks(drive_of(scene))[self._number(scene)]

    def _blocks(self, drive: str) -> list[dict[str, Any]]:
        if drive not in self._read:
            self._read[drive] = json.loads(Path(self._blocks_file(drive)).read_text(encoding="utf-8"))["blocks"]
        return self._read[drive]


class _Named:
    """Wildcards of a scene."""

    def __init__(self, scene: str):
        self.scene = scene


def _beside(block: dict[str, Any], other: dict[str, Any]) -> bool:
    """As `drivesplat.scene.blocks.Blocks.beside`."""

    def meet(some: list[list[int]], others: list[list[int]]) -> bool:
        return any(max(a, c) < min(b, d) for a, b in some for c, d in others)

    return meet(block["used"], other["core"]) or meet(other["used"], block["core"])
