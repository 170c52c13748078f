"""The content of discovered.json: the tracks that LiDAR scans give, and how good they are."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drivesplat.io.json_record import read_typed_json, write_typed_json
from drivesplat.io.storage import Provenance, no_provenance
from drivesplat.scene.scene import Track

RULE = "discover"
SCHEMA = 1


@dataclass(frozen=True)
class DiscoveredTracks:
    """The `tracks` of objects that move in `scans` scans of one LiDAR, annotated at the key frames in which they were
    seen; and `quality`, how they compare with annotated ones (`tracks_quality`), None where there is none."""

    lidar: str
    scans: int
    tracks: tuple[Track, ...]
    quality: dict[str, Any] | None = None
    provenance: Provenance = field(default_factory=no_provenance)


def write_discovered(path: str | Path, record: DiscoveredTracks) -> None:
    write_typed_json(path, record, SCHEMA)


def read_discovered(path: str | Path) -> DiscoveredTracks:
    """Reads discovered.json. Raises ResultError that names the file and its rule if it is invalid."""
    return read_typed_json(path, RULE, DiscoveredTracks, SCHEMA, "a record of discovered tracks")
