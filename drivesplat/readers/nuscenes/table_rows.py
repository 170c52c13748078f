"""Rows of the tables of nuScenes v1.0, as a writer collects them.

Schema: https://www.nuscenes.org/nuscenes (nuScenes schema), as nuscenes-devkit 1.2 reads it.
"""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.io.storage import atomic_write, write_json
from drivesplat.readers.nuscenes.layout import TABLES
from drivesplat.readers.nuscenes.tokens import token

MAP = "maps/empty.png"
VISIBILITY = {"1": "v0-40", "2": "v40-60", "3": "v60-80", "4": "v80-100"}


class TableRows:
    """The rows of all tables, and those that every dataset has: its log, an empty map, the levels of visibility, and
    `attributes`."""

    def __init__(self, log_token: str, log: dict[str, str], attributes: tuple[str, ...]):
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        self._instances: dict[str, dict[str, Any]] = {}
        self._last: dict[tuple, dict[str, Any]] = {}
        self.add("log", log_token, **log)
        self.add("map", token("map"), category="semantic_prior", filename=MAP, log_tokens=[log_token])
        for level, name in VISIBILITY.items():
            self.add("visibility", level, level=name, description=f"visible fraction {name[1:]} %")
        for attribute in attributes:
            self.add("attribute", token(attribute), name=attribute, description="")

    def add(self, table: str, token: str, **values: Any) -> dict[str, Any]:
        row = {"token": token, **values}
        self.rows[table].append(row)
        return row

    def add_linked(self, table: str, chain: tuple, token: str, **values: Any) -> dict[str, Any]:
        """Adds a row that is linked to the one before it in the same `chain`."""
        before = self._last.get((table, *chain))
        row = self.add(table, token, prev=before["token"] if before else "", next="", **values)
        if before:
            before["next"] = row["token"]
        self._last[(table, *chain)] = row
        return row

    def add_annotation(self, token_of: tuple, instance: str, category: str, size: np.ndarray, **values: Any) -> None:
        """Adds a box of an instance, after its earlier ones, with the rows of the instance and of its category where
        they are new. `size` (3,): length, width, height in metres."""
        row = self.add_linked(
            "sample_annotation", (instance,), token(*token_of), instance_token=instance,
            size=[size[1], size[0], size[2]], num_radar_pts=0, **values,
        )  # fmt: skip
        if not any(known["name"] == category for known in self.rows["category"]):
            self.add("category", token("category", category), name=category, description="")
        known = self._instances.get(instance) or self.add(
            "instance", instance, category_token=token("category", category), nbr_annotations=0,
            first_annotation_token=row["token"],
        )  # fmt: skip
        self._instances[instance] = known
        known["nbr_annotations"] += 1
        known["last_annotation_token"] = row["token"]

    def write(self, root: Path, version: str) -> None:
        """Writes `root`/`version`/*.json and the map image that nuscenes-devkit requires."""
        with atomic_write(root / MAP) as file:
            Image.new("L", (8, 8)).save(file, format="PNG")
        for name, rows in self.rows.items():
            write_json(root / version / f"{name}.json", rows)


def pose_columns(pose: np.ndarray) -> dict[str, list[float]]:
    """The columns of a pose (4, 4); rotations are quaternions w, x, y, z."""
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
    return {"translation": pose[:3, 3].tolist(), "rotation": [w, x, y, z]}
