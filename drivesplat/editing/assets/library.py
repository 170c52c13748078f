"""Reading the assets that an edit inserts."""

from pathlib import Path

from drivesplat.editing.assets.asset import NO_INSERTS, Asset, Inserts, read_asset
from drivesplat.errors import ResultError
from drivesplat.io.storage import read_record, sha256_text, unreadable
from drivesplat.scene.light import OVERCAST, read_light
from drivesplat.scene.tracks import matching_ids
from drivesplat.settings.asset_references import LIGHT, asset_names, asset_of_results, files_of_asset
from drivesplat.settings.edit import Edit

RULE = "actor_assets"


def read_inserts(edit: Edit | None, folder: Path) -> Inserts:
    """What an edit inserts, for the method with the result folder `folder`. Without light.json the light of the scene
    is OVERCAST.

    Raises ConfigError for a name that is no asset's, ResultError for files that are missing or none of an asset.
    """
    names = [] if edit is None else asset_names(edit)
    if not names:
        return NO_INSERTS
    light = folder.parent / LIGHT
    assets = {name: _read(name, folder.parent.parent, folder.name) for name in names}
    return Inserts(assets, read_light(light) if light.is_file() else OVERCAST)


def digests_of(inserts: Inserts) -> dict[str, str]:
    """The digests of the files that were read, for the provenance of what is made with them."""
    found = {f"asset {name}": asset.digest for name, asset in inserts.assets.items()}
    return {**found, "light": sha256_text(repr(inserts.light))} if found else {}


def _read(name: str, results: Path, method: str) -> Asset:
    (file, *_), found = files_of_asset(name, results, method), asset_of_results(name, method)
    if found is None:
        return read_asset(file.parent)
    folders = read_asset_index(file)
    matching = matching_ids(found[2], list(folders))
    if len(matching) != 1:
        count = f"{len(matching)} assets have" if matching else "no asset has"
        known = ", ".join(folders) or "none"
        raise ResultError(f"{file}: {count} an id starting with {found[2]!r}; there are: {known}")
    return read_asset(file.parent / folders[matching[0]])


def read_asset_index(file: Path) -> dict[str, str]:
    """The folders of a method's assets by their tracks, from assets.json. Raises ResultError where it is not one."""
    index = read_record(file, RULE, "assets")
    try:
        folders = {str(record["track"]): str(record["folder"]) for record in index["assets"]}
    except (KeyError, TypeError) as error:
        raise unreadable(file, RULE, f"not what the rule writes (it lacks {error})") from error
    for folder in folders.values():
        if Path(folder).name != folder or folder in ("", ".."):
            raise unreadable(file, RULE, f"{folder!r} is not a folder beside it")
    return folders
