"""The page that shows a library of assets: one file, with a small picture of each asset inside."""

import base64
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from drivesplat.editing.assets import library_page
from drivesplat.editing.assets.library_entry import LibraryEntry
from drivesplat.io.html_page import filled_page


def library_html(folder: Path, entries: Sequence[LibraryEntry]) -> str:
    """The text of index.html of the library in a folder. It needs no network; turntables are read from the folders
    beside it, where they are."""
    pictures = {
        own.id: "data:image/webp;base64," + base64.b64encode((folder / own.thumbnail).read_bytes()).decode()
        for own in entries
        if own.thumbnail
    }
    counts = sorted(Counter(own.object_class.value for own in entries).items())
    return filled_page(library_page, folder=folder.resolve().name, entries=entries, pictures=pictures, counts=counts)
