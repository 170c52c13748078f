"""The content of discovered.json: the tracks that LiDAR scans give, and how good they are."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from drivesplat.io.storage import Provenance, read_json, unreadable, write_json
from drivesplat.io.typed_record import field_values, typed_record
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
    provenance: Provenance = field(default_factory=dict)


def write_discovered(path: str | Path, record: DiscoveredTracks) -> None:
    """Writes discovered.json."""
    write_json(path, {"schema": SCHEMA, **field_values(record)}, _plain)


def read_discovered(path: str | Path) -> DiscoveredTracks:
    """Reads discovered.json. Raises ResultError that names the file and its rule if it is invalid."""
    content = read_json(path, RULE)
    try:
        if content.pop("schema") != SCHEMA:
            raise ValueError("it has another schema")
        return typed_record(DiscoveredTracks, content, json=True)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise unreadable(path, RULE, f"not a record of discovered tracks ({error})") from error


def _plain(value: Any) -> Any:
    return value.tolist() if isinstance(value, np.ndarray) else field_values(value)
