"""Where the tracks of a method come from, and where results that depend on them lie.

Results for annotated tracks lie in the folder of the scene. Those for other tracks lie in folders below it, under the
same names.
"""

from typing import Literal

Tracks = Literal["annotated", "discovered", "none"]
TRACK_FOLDERS: dict[Tracks, str] = {"annotated": "", "discovered": "discovered", "none": "unlabelled"}
"""The folder, below that of a scene, of what depends on tracks."""
OTHER_TRACKS = tuple(folder for folder in TRACK_FOLDERS.values() if folder)
"""The folders of tracks that replace the annotated ones."""
FOUND = "found_"
"""Start of the ids of discovered tracks."""
