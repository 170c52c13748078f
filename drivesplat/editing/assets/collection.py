"""Collecting the assets of many scenes and methods in one library.

collected = collect_assets(Path("results"), Path("library"), classes=["car"])
print(collected.words)
"""

import filecmp
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from drivesplat.editing.assets.asset import read_asset
from drivesplat.editing.assets.asset_library import AssetLibrary, library_name
from drivesplat.editing.assets.library import read_asset_index
from drivesplat.editing.assets.library_entry import read_entry
from drivesplat.errors import RequestError, ResultError
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings.asset_references import FOLDER, INDEX, PLY, RECORD


@dataclass(frozen=True)
class CollectedAssets:
    """How many assets were added, replaced by a newer export, there already, and left out by what was asked for; and
    how many the library has."""

    added: int
    replaced: int
    kept: int
    left_out: int
    total: int

    @property
    def words(self) -> str:
        return (
            f"{self.added} added, {self.replaced} replaced, {self.kept} unchanged, {self.left_out} left out; "
            f"the library has {self.total}"
        )


def collect_assets(
    results: Path, folder: Path, classes: Sequence[str] = (), min_psnr: float | None = None
) -> CollectedAssets:
    """Copies the assets of all scenes and methods below `results` into the library in `folder`, each as
    `{scene}_{method}_{track}`, those of `classes` alone if there are any, and those of at least `min_psnr` dB in
    held-out images. Assets that are in the library stay.

    Raises RequestError for an unknown class and for a name that another asset has, ResultError where there are no
    assets, or files of one are damaged.
    """
    if unknown := [name for name in classes if name not in {*ObjectClass}]:
        raise RequestError(f"there is no class {unknown[0]!r}; known are {', '.join(ObjectClass)}")
    found = _folders(results)
    library, counts = AssetLibrary(folder), {"added": 0, "replaced": 0, "kept": 0, "left_out": 0}
    library.check()
    for name, origin in found.items():
        own = read_entry(origin)
        missed = min_psnr is not None and (own.psnr is None or own.psnr < min_psnr)
        if missed or (classes and own.object_class not in classes):
            counts["left_out"] += 1
        elif _is_same(origin, folder / name):
            counts["kept"] += 1
        else:
            asset = read_asset(origin)  # which checks its files
            counts["replaced" if library.copy(name, asset.source, origin) else "added"] += 1
    return CollectedAssets(**counts, total=len(library.write_index()))


def _folders(results: Path) -> dict[str, Path]:
    """The folders of assets below a results folder by their names in a library."""
    if not results.is_dir():
        raise ResultError(f"there is no folder {results}")
    found: dict[str, Path] = {}
    for index in sorted(results.glob(f"*/*/{FOLDER}/{INDEX}")):
        scene, method = index.parents[2].name, index.parents[1].name
        for track, folder in read_asset_index(index).items():
            name = library_name(f"{scene}_{method}_{track}")
            if name in found:
                raise RequestError(f"{found[name]} and {index.parent / folder} would both be called {name!r}")
            found[name] = index.parent / folder
    if not found:
        raise ResultError(f"{results} has no assets: `snakemake --cores 4 assets` makes them")
    return found


def _is_same(origin: Path, own: Path) -> bool:
    """Whether a folder has the asset of another, byte by byte."""
    _, changed, unread = filecmp.cmpfiles(origin, own, (RECORD, PLY), shallow=False)
    return not changed and not unread
