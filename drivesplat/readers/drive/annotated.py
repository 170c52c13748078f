"""Whether a drive folder has tracks, for planning."""

from pathlib import Path

from drivesplat.readers.drive.layout import FILE, _content, scene_folder


def has_tracks(root: Path, version: str, scene: str) -> bool | None:
    """Whether a scene has tracks; None where its drive.json has faults, which `read` names. Raises DatasetError where
    there is no such scene."""
    file = scene_folder(root, scene) / FILE
    try:
        return bool(_content(file, file.stat().st_mtime_ns).get("tracks"))
    except (AttributeError, OSError, RecursionError, ValueError):
        return None
