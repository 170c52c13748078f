"""Drives that are cut into blocks: which scenes they become, and the files that blocks and drives are made from."""

import json
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from drivesplat.errors import ConfigError
from drivesplat.settings.blocks import BLOCKS, block_scene_name, drive_of
from drivesplat.settings.config import Config, for_scene
from drivesplat.workflow.film_names import EDITS, scene_edits
from drivesplat.workflow.outputs import SPLATS, Outputs
from drivesplat.workflow.without_cameras import scene_methods

OF_DRIVES = (
    "scene.json", "scene_refined.json", "poses.json", "triangulated.npz", BLOCKS, "metrics.json", "index.html",
)  # fmt: skip
"""The results of a drive that is cut into blocks; others are those of blocks."""
OF_DRIVES_ALONE = ("scene_refined.json", "poses.json", "triangulated.npz", BLOCKS)
"""Those of them that blocks do not have."""
FILES_OF_TARGETS = {
    "edits": "{method}/edits/NAME.mp4",
    "drives": "{method}/edits/NAME/drive/drive.json",
    "assets": "{method}/assets/assets.json",
    "runs": "{method}/runs/NAME.json",
    "mcap": "{method}/drive.mcap",
    "looks": "{method}/removal.png",
    "exports": "{method}/viewer.html",
    "alpasim": "{method}/scene.alpasim.usdz",
}
"""What the targets that make nothing, or little, of such a drive make of a scene: a file of each."""
DRIVE_EXPORTS = ("scene.usd", "viewer.html")
"""Exports of a whole drive, of each method, beside its splats."""
EDIT_FILES = (".mp4", ".png", ".json")
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
        """The function of wildcards that gives the result `name` of every block of a drive that is not left out, in
        order. In it, '{method}' is the method of the job."""
        folder = self._plan.config.results_dir
        return self.each(lambda block: f"{folder}/{block.scene}/{name.format(method=block.method)}")

    def each(self, find: Callable[[Any], str]) -> Callable[[Any], list[str]]:
        """The function of wildcards that gives what `find` does for every block of a drive that is not left out, in
        order: for the wildcards of the block, with the method of the job."""

        def of_blocks(wildcards: Any) -> list[str]:
            drive, method = wildcards.scene, getattr(wildcards, "method", "")
            self._blocks_file(drive)
            numbers = _kept(self._plan.config, drive, len(self._blocks(drive)))
            return [find(SimpleNamespace(scene=block_scene_name(drive, number), method=method)) for number in numbers]

        return of_blocks

    def previous(self, wildcards: Any) -> list[str]:
        """The checkpoint that the training of a job starts from, that of the same method in the block before: none
        for a scene that is no block, for blocks that are trained alone, behind a block that is left out, and for a
        block that has none before it (`Block.previous`)."""
        before = self._scene_before(wildcards.scene)
        if before is None:
            return []
        return [f"{self._plan.config.results_dir}/{before}/{wildcards.method}/checkpoint.npz"]

    def previous_parser(self, wildcards: Any) -> list[str]:
        """The training record of the block that `previous` names."""
        before = self._scene_before(wildcards.scene)
        if before is None:
            return []
        return [self._plan.of_tracks("parser.npz")(SimpleNamespace(scene=before, method=wildcards.method))]

    def _scene_before(self, scene: str) -> str | None:
        """The block whose model the training of a scene starts from."""
        config, drive = self._plan.config, drive_of(scene)
        settings = config.datasets[config.dataset_of(scene)].blocks if config.is_block(scene) else None
        if settings is None or settings.init == "alone":
            return None
        self._blocks_file(drive)
        number = self._block(scene).get("previous")
        left_out = number is not None and number not in _kept(config, drive, len(self._blocks(drive)))
        return None if number is None or left_out else block_scene_name(drive, number)

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


def require_left_out(config: Config, scene: str) -> None:
    """Raises ConfigError for a drive whose blocks are known and that leaves out others than these, or all."""
    count = _known_count(config, scene) if config.is_cut(scene) else None
    if count is not None:
        _kept(config, scene, count)


def _kept(config: Config, drive: str, count: int) -> list[int]:
    """The numbers of the blocks of a drive, which has so many, that are not left out."""
    left_out = config.datasets[config.dataset_of(drive)].left_out(drive)
    for number in left_out:
        if number >= count:
            raise ConfigError(
                f"blocks.leave_out names block {number} of scene {drive}, which has {count}, counted from 0"
            )
    if len(left_out) == count:
        raise ConfigError(f"blocks.leave_out leaves no block of scene {drive}, which has {count}; keep one")
    return [number for number in range(count) if number not in left_out]


def _known_count(config: Config, drive: str) -> int | None:
    """The number of the blocks of a drive; None before it is cut."""
    known = _known(config, drive)
    return None if known is None else len(known["blocks"])


def _known(config: Config, drive: str) -> dict[str, Any] | None:
    """The content of a drive's blocks.json; None before it is cut, and where the file is damaged."""
    try:
        known = json.loads(Path(config.results_dir, drive, BLOCKS).read_text(encoding="utf-8"))
        return known if isinstance(known["blocks"], list) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def chosen_lengths(config: Config, jobs: Iterable[Any]) -> list[str]:
    """A sentence for each drive with length_m: auto of which some jobs are planned: the length of its blocks, and why,
    or that the run chooses it."""
    named = [(job.rule.name, job.wildcards.scene) for job in jobs if hasattr(job.wildcards, "scene")]
    sentences = []
    for drive in dict.fromkeys(drive_of(scene) if config.is_block(scene) else scene for _, scene in named):
        settings = config.datasets[config.dataset_of(drive)].blocks
        if settings is None or settings.length_m != "auto":
            continue
        known = None if ("blocks", drive) in named else _known(config, drive)
        if known and known.get("reason"):
            sentences.append(f"scene {drive}: blocks of {known['length_m']:g} m: {known['reason']}")
        else:
            chosen = f"the length of its blocks is chosen by blocks.memory_gb: {settings.memory_gb:g}"
            sentences.append(f"scene {drive}: {chosen} when it is cut, which says why")
    return sentences


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
    films = _films(config, scene)
    own = {"eval.json", "eval_objects.json", *DRIVE_EXPORTS, *(f"{name}{end}" for name in films for end in FILM_FILES)}
    known = path[-1] in (own if len(path) == 2 else OF_DRIVES) if len(path) < 3 else path[1:] == SPLATS.split("/")
    is_edit = len(path) == 3 and path[1] == EDITS and path[2].endswith(EDIT_FILES)
    known = known or (is_edit and bool(scene_edits(config, scene)))
    if not known:
        raise ConfigError(
            f"scene {scene} is cut into blocks, and {'/'.join(path)} is a result of one block: ask for "
            f"{config.results_dir}/{block_scene_name(scene, 0)}/{'/'.join(path)}; {_what_there_is(config, scene)}"
        )


def targets_without_drives(plan: Outputs, targets: Sequence[str]) -> list[str]:
    """A sentence for each of these targets and each drive of the batch that is cut into blocks and of which the target
    makes nothing, or no more than its splats."""
    config = plan.config
    made: dict[str, Callable[[], list[str]]] = {
        "edits": plan.edits,
        "drives": plan.drives,
        "assets": plan.assets,
        "runs": plan.runs,
        "mcap": plan.mcap_files,
        "looks": plan.looks,
        "exports": plan.exports,
        "alpasim": plan.alpasim,
    }
    sentences = []
    for target in (name for name in dict.fromkeys(targets) if name in made):
        files = [Path(file).relative_to(config.results_dir) for file in made[target]()]
        of_blocks = {drive_of(file.parts[0]) for file in files if not file.as_posix().endswith(SPLATS)}
        for scene in config.batch_scenes:
            if config.is_cut(scene) and scene not in of_blocks:
                methods = scene_methods(config, scene)
                method = next((one for one in methods if one in plan.methods_with_actors), methods[0])
                example = f"{block_scene_name(scene, 0)}/{FILES_OF_TARGETS[target].format(method=method)}"
                little = "splats alone" if target == "exports" else "nothing"
                sentences.append(
                    f"scene {scene} is cut into blocks: {target} makes {little} of it; ask for files of blocks, as "
                    f"{config.results_dir}/{example}; {_what_there_is(config, scene)}"
                )
    return sentences


def _what_there_is(config: Config, scene: str) -> str:
    """The results of a drive that is cut into blocks and the names of its blocks, as the end of a sentence."""
    edited = [f"{EDITS}/NAME.mp4"] if scene in config.datasets[config.dataset_of(scene)].edits else []
    films = ", ".join([*(f"{name}.mp4" for name in _films(config, scene)), *edited])
    count = _known_count(config, scene)
    last = f"to {block_scene_name(scene, count - 1)}" if count else "and so on"
    blocks = f"{block_scene_name(scene, 0)} {last}"
    return (
        f"its blocks are {blocks}, and of the whole drive there are metrics.json, index.html and, of each method, "
        f"{films}, {', '.join(DRIVE_EXPORTS)} and {SPLATS} (docs/long_drives.md)"
    )


def _films(config: Config, scene: str) -> list[str]:
    """The films of a drive that is cut into blocks."""
    trajectories = for_scene(config, scene).render.trajectories.items()
    return [name for name, trajectory in trajectories if trajectory.parts == "all"]
