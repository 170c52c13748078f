"""Drives that are cut into blocks: which scenes they become, and the files that blocks and drives are made from."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.settings.blocks import block_scene_name, drive_of
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.outputs import SPLATS, Outputs

OF_DRIVES = (
    "scene.json", "scene_refined.json", "poses.json", "triangulated.npz", "blocks.json", "metrics.json", "index.html",
)  # fmt: skip
"""The results of a drive that is cut into blocks; others are those of blocks."""
OF_DRIVES_ALONE = ("scene_refined.json", "poses.json", "triangulated.npz", "blocks.json")
"""Those of them that blocks do not have."""
FILM_FILES = (".mp4", ".cameras.json")


class LongDrives:
    """The drives of a `plan` that are cut into blocks. `blocks_file` gives the blocks.json of a drive by its name, or
    lets Snakemake make it and ask again."""

    def __init__(self, plan: Outputs, blocks_file: Callable[[str], str]):
        self._plan, self._blocks_file = plan, blocks_file
        self._read: dict[str, list[dict[str, Any]]] = {}

    def inputs_of_block(self, wildcards: Any) -> list[str]:
        """The scene of a block's drive, and its blocks.json. Raises ConfigError for a block that the drive lacks."""
        drive = drive_of(wildcards.scene)
        file = self._blocks_file(drive)
        self._block(wildcards.scene)
        return [self._plan.annotated_scene(SimpleNamespace(scene=drive)), file]

    def digest(self, wildcards: Any) -> str:
        """That of a block's recordings: a block whose recordings are the same is not made again, however the drive goes
        on."""
        return str(self._block(wildcards.scene)["digest"])

    def results(self, name: str) -> Callable[[Any], list[str]]:
        """The function of wildcards that gives the result `name` of every block of a drive, in order. In it, '{method}'
        is the method of the job."""

        def of_blocks(wildcards: Any) -> list[str]:
            self._blocks_file(wildcards.scene)
            folder, own = self._plan.config.results_dir, name.format(method=getattr(wildcards, "method", ""))
            count = len(self._blocks(wildcards.scene))
            return [f"{folder}/{block_scene_name(wildcards.scene, number)}/{own}" for number in range(count)]

        return of_blocks

    def _block(self, scene: str) -> dict[str, Any]:
        drive, number = drive_of(scene), int(scene.rpartition(".")[2])
        blocks = self._blocks(drive)
        if number >= len(blocks) or scene != block_scene_name(drive, number):
            raise ConfigError(
                f"scene {drive} has no block called {scene}; it has {len(blocks)}: {block_scene_name(drive, 0)} to "
                f"{block_scene_name(drive, len(blocks) - 1)}"
            )
        return blocks[number]

    def _blocks(self, drive: str) -> list[dict[str, Any]]:
        if drive not in self._read:
            self._read[drive] = json.loads(Path(self._blocks_file(drive)).read_text(encoding="utf-8"))["blocks"]
        return self._read[drive]


def require_cameras(config: Config, scene: str) -> None:
    """Raises ConfigError for a drive without cameras that is cut into blocks: these are measured by images."""
    if config.is_cut(scene) and not for_scene(config, scene).cameras:
        raise ConfigError(
            f"scene {scene} has no camera (cameras: []), and blocks are measured by images: leave out blocks"
        )


def refuse_results_of_blocks(config: Config, scene: str, path: Sequence[str]) -> None:
    """Raises ConfigError if `path` below the folder of a drive that is cut into blocks is a result that only blocks
    have."""
    if config.is_block(scene) and path[0] in OF_DRIVES_ALONE:
        raise ConfigError(
            f"{path[0]} is a result of the whole drive: ask for {config.results_dir}/{drive_of(scene)}/{path[0]}"
        )
    if not config.is_cut(scene):
        return
    trajectories = for_scene(config, scene).render.trajectories.items()
    films = [name for name, trajectory in trajectories if trajectory.parts == "all"]
    own = {"eval.json", "eval_objects.json", *(f"{name}{end}" for name in films for end in FILM_FILES)}
    known = path[-1] in (own if len(path) == 2 else OF_DRIVES) if len(path) < 3 else path[1:] == SPLATS.split("/")
    if not known:
        raise ConfigError(
            f"scene {scene} is cut into blocks, and {'/'.join(path)} is a result of one block: ask for "
            f"{config.results_dir}/{block_scene_name(scene, 0)}/{'/'.join(path)} (docs/long_drives.md)"
        )
