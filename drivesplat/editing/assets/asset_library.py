"""A library of assets: a folder with an asset in each of its folders, and an index and a page of all.

`library.json` lists them, `index.html` shows them, `{name}/` has the files of an asset and `thumbnail.webp`. Both are
made of the folders: a folder that is removed is gone from them at the next `write_index`.
"""

import base64
import re
import shutil
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, UnidentifiedImageError

from drivesplat.editing.assets import library_page
from drivesplat.editing.assets.asset import TURNTABLE, Asset, write_asset
from drivesplat.editing.assets.formats.foreign import json_of
from drivesplat.editing.assets.library_entry import THUMBNAIL, LibraryEntry, read_entry
from drivesplat.editing.assets.turntable import write_turntable
from drivesplat.errors import RequestError, ResultError
from drivesplat.io.file_lock import waiting_for_lock
from drivesplat.io.html_page import filled_page
from drivesplat.io.storage import atomic_write, write_json
from drivesplat.settings.asset_references import PLY, RECORD

INDEX, PAGE, LOCK = "library.json", "index.html", ".lock"
LIBRARY_SCHEMA = 1
THUMBNAIL_SIZE, THUMBNAIL_FRAME = (200, 150), 3
"""Pixels, and the picture of the turntable that a thumbnail is: from the front, to the left."""
FILES = (PLY, RECORD, TURNTABLE, THUMBNAIL)
"""Of an asset in a library; the record is the last that is written."""


def library_name(words: str) -> str:
    """A name of an asset as a folder that is valid on every system and in every format. Raises RequestError for words
    without a letter or a digit."""
    name = re.sub(r"[^A-Za-z0-9_-]", "_", words).lstrip("_-")
    if not name:
        raise RequestError(f"{words!r} is no name of an asset: it has neither letter nor digit")
    return name


@dataclass(frozen=True)
class AssetLibrary:
    """The library in a folder, which need not exist yet."""

    folder: Path

    def check(self) -> None:
        """Raises RequestError for a folder of other files, ResultError for a library of another version."""
        index = self.folder / INDEX
        if not index.is_file():
            others = [path for path in self.folder.glob("*") if not path.name.startswith(".")]
            if others or (self.folder.exists() and not self.folder.is_dir()):
                raise RequestError(f"{self.folder} is not a library: it has no {INDEX}; name a new or an empty folder")
            return
        content = json_of(index)
        schema = content.get("schema") if isinstance(content, dict) else None
        if schema != LIBRARY_SCHEMA:
            raise ResultError(
                f"{index}: its schema is {schema!r}, not {LIBRARY_SCHEMA}; name the folder of another library"
            )

    def add(self, name: str, asset: Asset) -> bool:
        """Adds an asset, with a turntable, in the place of the same asset. Returns whether there was one.

        Raises RequestError where the name is that of another asset.
        """

        def write(folder: Path) -> None:
            write_turntable(folder / TURNTABLE, asset)
            write_asset(folder, asset)

        return self._put(name, asset.source, write)

    def copy(self, name: str, source: Mapping[str, Any], origin: Path) -> bool:
        """Adds the files of the folder `origin`, an asset from `source`, as `add`."""

        def write(folder: Path) -> None:
            for file in (TURNTABLE, PLY, RECORD):
                if not (origin / file).is_file():
                    (folder / file).unlink(missing_ok=True)
                else:
                    with open(origin / file, "rb") as read, atomic_write(folder / file) as written:
                        shutil.copyfileobj(read, written)

        return self._put(name, source, write)

    def entries(self) -> list[LibraryEntry]:
        """Its assets by name. Raises ResultError where a record is none of an asset."""
        return [read_entry(record.parent) for record in sorted(self.folder.glob(f"*/{RECORD}"))]

    def write_index(self) -> list[LibraryEntry]:
        """Writes the index and the page of all assets that are there; returns their entries."""
        with waiting_for_lock(self.folder / LOCK):
            entries = self.entries()
            self._write(entries)
        return entries

    def _write(self, entries: list[LibraryEntry]) -> None:
        write_json(self.folder / INDEX, {"schema": LIBRARY_SCHEMA, "assets": [own.record() for own in entries]})
        with atomic_write(self.folder / PAGE) as file:
            file.write(_page(self.folder, entries).encode())

    def _put(self, name: str, source: Mapping[str, Any], write: Callable[[Path], None]) -> bool:
        self.check()
        with waiting_for_lock(self.folder / LOCK):
            if not (self.folder / INDEX).is_file():
                self._write([])
            folder, known = self.folder / name, (self.folder / name / RECORD).is_file()
            if not known and any(path.name not in FILES for path in folder.glob("*")):
                raise RequestError(f"the name {name!r} is taken in {self.folder} by files of no asset")
            if known and dict((there := read_entry(folder)).source) != dict(source):
                raise RequestError(
                    f"the name {name!r} is taken in {self.folder} by another asset "
                    f"({there.origin or 'of unknown source'}): give another name, or remove that folder"
                )
            write(folder)
            _write_thumbnail(folder)
        return known


def _page(folder: Path, entries: Sequence[LibraryEntry]) -> str:
    """The text of index.html of the library in a folder, with a small picture of each asset inside. It needs no
    network; turntables are read from the folders beside it, where they are."""
    pictures = {
        own.id: "data:image/webp;base64," + base64.b64encode((folder / own.thumbnail).read_bytes()).decode()
        for own in entries
        if own.thumbnail
    }
    counts = sorted(Counter(own.object_class.value for own in entries).items())
    return filled_page(library_page, folder=folder.resolve().name, entries=entries, pictures=pictures, counts=counts)


def _write_thumbnail(folder: Path) -> None:
    """Writes a small picture of the asset, where it has a turntable."""
    if not (folder / TURNTABLE).is_file():
        (folder / THUMBNAIL).unlink(missing_ok=True)
        return
    try:
        with Image.open(folder / TURNTABLE) as moving:
            moving.seek(min(THUMBNAIL_FRAME, getattr(moving, "n_frames", 1) - 1))
            picture = moving.convert("RGB").resize(THUMBNAIL_SIZE)
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError) as error:
        raise ResultError(f"{folder / TURNTABLE}: not a picture ({error})") from error
    with atomic_write(folder / THUMBNAIL) as file:
        picture.save(file, format="WEBP", quality=75)
