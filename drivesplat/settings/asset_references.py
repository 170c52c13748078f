"""The assets that the steps of an edit name, and their files.

`{scene}/{track}` and `{scene}/{method}/{track}` are assets of results; without a method, of the one that is edited. A
name that starts with `/`, `./`, `../` or `~` is the path of an asset's folder.
"""

from pathlib import Path

from drivesplat.errors import ConfigError
from drivesplat.settings.edit import Edit

FOLDER, INDEX = "assets", "assets.json"
"""The folder of a method's assets, and the file there that lists them."""
LIGHT = "light.json"
"""The file of the light of a scene."""
RECORD, PLY = "asset.json", "asset.ply"
"""The files of an asset."""
OF_A_PATH = ("/", "./", "../", "~")


def asset_names(edit: Edit) -> list[str]:
    """The names of the assets that an edit inserts, each once."""
    return list(dict.fromkeys(step.insert.asset for step in edit.steps if step.insert is not None))


def asset_of_results(name: str, method: str) -> tuple[str, str, str] | None:
    """Scene, method and track of an asset of results, which an edit of `method` names; None for a path. Raises
    ConfigError for a name that is neither."""
    if name.startswith(OF_A_PATH):
        return None
    parts = name.split("/")
    if len(parts) not in (2, 3) or not all(parts):
        raise ConfigError(
            f"asset {name!r} is neither {{scene}}/{{track}} nor {{scene}}/{{method}}/{{track}}; the path of an asset's "
            "folder starts with './' or '/'"
        )
    scene, *given, track = parts
    return scene, *(given or [method]), track


def files_of_asset(name: str, results: Path, method: str) -> list[Path]:
    """The files that a rule needs to read an asset: the index of a method's assets, or the files of a folder."""
    found = asset_of_results(name, method)
    if found is None:
        return [Path(name).expanduser() / file for file in (RECORD, PLY)]
    return [results / found[0] / found[1] / FOLDER / INDEX]
