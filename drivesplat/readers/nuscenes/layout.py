"""The location of the files of nuScenes."""

import json
from importlib.util import find_spec
from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.io.regular_file import regular_file

TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
HOW_TO_GET_IT = (
    "download it from https://www.nuscenes.org/nuscenes (free registration), unpack it there, "
    "or set datasets.<name>.dataroot in config.yaml"
)
HOW_TO_GET_MINI = (
    "`snakemake --cores 1 download_nuscenes_mini` fetches it, where you accept nuScenes' terms (docs/data.md); or "
)


def missing_package() -> str | None:
    """The package that reading tables needs and this Python lacks, with what to do; None if it is installed."""
    if find_spec("nuscenes") is not None:
        return None
    return (
        "nuscenes-devkit, which reads these tables, is not installed: pip install --no-deps 'nuscenes-devkit>=1.2,<2' "
        "(it asks for numpy < 2 without need)"
    )


def how_to_get_it(version: str) -> str:
    """How to get a missing version of nuScenes, for messages."""
    return (HOW_TO_GET_MINI if version == "v1.0-mini" else "") + HOW_TO_GET_IT


def find_root(dataroot: str, version: str) -> Path:
    """The folder that holds the tables' folder `version`: `dataroot` itself, its parent, or its folder of that name.

    Raises DatasetError that says which file is missing, where, and how to get it.
    """
    given = Path(dataroot).expanduser()
    for root in (given, given.parent, given / version):
        if (
            root.is_dir()
            and (root / version / "scene.json").is_file()
            and (root != given.parent or given.name == version)
        ):
            return root
    if not given.is_dir():
        raise DatasetError(f"nuScenes {version} not found: there is no folder {given}; {how_to_get_it(version)}")
    others = sorted(p.parent.name for p in given.glob("v1.0-*/scene.json"))
    found = (
        f"it holds {', '.join(others)}: set datasets.<name>.version"
        if others
        else f"it holds no nuScenes tables; {how_to_get_it(version)}"
    )
    raise DatasetError(f"nuScenes {version} not found: looked for {version}/scene.json in {given}; {found}")


def table_files(root: Path, version: str, scene: str) -> list[Path]:
    """The files from which `read` reads a scene: for every scene all tables. Raises DatasetError as `all_tables`."""
    return all_tables(root, version)


def camera_names(root: Path, version: str) -> list[str]:
    """The names of the cameras that recorded a dataset. Raises DatasetError if the table of sensors is damaged."""
    table = root / version / "sensor.json"
    try:
        rows = json.loads(regular_file(table).read_text(encoding="utf-8"))
        return [str(row["channel"]) for row in rows if row["modality"] == "camera"]
    except (KeyError, OSError, RecursionError, TypeError, ValueError) as error:
        raise DatasetError(f"{table} cannot be read ({type(error).__name__}: {error}); unpack it again") from error


def all_tables(root: Path, version: str) -> list[Path]:
    """The files of all tables. Raises DatasetError naming the tables that are missing."""
    files = [root / version / f"{name}.json" for name in TABLES]
    absent = [file.name for file in files if not file.is_file()]
    if absent:
        raise DatasetError(
            f"nuScenes {version} in {root} is incomplete: {', '.join(absent)} missing; {how_to_get_it(version)}"
        )
    return files
