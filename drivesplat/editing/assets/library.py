"""Reading the assets that an edit inserts."""

from pathlib import Path

from drivesplat.editing.assets.asset import Asset, Assets, read_asset
from drivesplat.errors import ResultError
from drivesplat.io.storage import read_record
from drivesplat.scene.tracks import matching_ids
from drivesplat.settings.asset_references import asset_names, asset_of_results, files_of_asset
from drivesplat.settings.edit import Edit

RULE = "actor_assets"


def read_assets(edit: Edit | None, results: Path, method: str) -> Assets:
    """The assets that an edit of `method` inserts (None: none), by their names there; `results` is the folder of all
    results.

    Raises ConfigError for a name that is no asset's, ResultError for files that are missing or none of an asset.
    """
    return {} if edit is None else {name: _read(name, results, method) for name in asset_names(edit)}


def digests_of(assets: Assets) -> dict[str, str]:
    """The digests of assets that were read, for the provenance of what is made with them."""
    return {f"asset {name}": asset.digest for name, asset in assets.items()}


def _read(name: str, results: Path, method: str) -> Asset:
    (file, *_), found = files_of_asset(name, results, method), asset_of_results(name, method)
    if found is None:
        return read_asset(file.parent)
    index = read_record(file, RULE, "assets")
    folders = {str(record["track"]): str(record["folder"]) for record in index["assets"]}
    matching = matching_ids(found[2], list(folders))
    if len(matching) != 1:
        count = f"{len(matching)} assets have" if matching else "no asset has"
        known = ", ".join(folders) or "none"
        raise ResultError(f"{file}: {count} an id starting with {found[2]!r}; there are: {known}")
    return read_asset(file.parent / folders[matching[0]])
