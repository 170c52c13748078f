"""An actor as an asset: asset.ply, its Gaussians in the frame of its box, and asset.json, what it is.

asset.ply is a splat as other programs read it (`drivesplat.model.splat_ply`), with two kinds of further properties:
`invented`, 1 for Gaussians of sides that no camera saw, and with LiDAR `lidar_0` to `lidar_7`, the `lidar_logits` of
`Gaussians` row by row. A file without them is an asset of which all was seen, and without lidar_logits, as one with a
part of the eight.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from pydantic import ValidationError
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.io.point_cloud import read_ply_data
from drivesplat.io.storage import Provenance, read_json, sha256_file, write_json
from drivesplat.kernels.spherical_harmonics import SH_C0
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_ply import read_splat_ply, write_splat_ply
from drivesplat.scene.light import OVERCAST, SceneLight
from drivesplat.scene.object_class import ObjectClass
from drivesplat.settings.asset_references import PLY, RECORD
from drivesplat.settings.deformable import GaitSettings, LatticeSettings

SCHEMA = 1
TURNTABLE = "turntable.webp"
FRAME = {"x": "forward", "y": "left", "z": "up", "origin": "centre of the box", "unit": "metre"}
"""The frame of an asset's files, as its record declares it. There is no other."""
MAX_GAUSSIANS = 2_000_000
MIN_EDGE, MAX_EDGE = 0.1, 30.0
"""Metres; the edges of the box of anything that drives or walks."""
MAX_OF_PEOPLE = 3.0
"""Metres; the longest edge of the box of a person."""
VISIBLE = np.radians(75.0)
"""A surface is seen from directions within this of the one that it faces; at grazing angles it is not."""
LIDAR = tuple(f"lidar_{i}" for i in range(8))
INVENTED = "invented"


@dataclass(frozen=True, eq=False)
class AssetGait:
    """How an asset walks: the length of a `cycle` in metres, and the nodes of its lattice for each of k functions of
    the phase (`drivesplat.model.deformable`)."""

    cycle: float
    settings: GaitSettings
    lattice: LatticeSettings
    nodes: Float[Tensor, "k x y z 6"]


@dataclass(frozen=True, eq=False)
class Asset:
    """An actor as an asset.

    `gaussians` are in the frame of its box (x forward, y left, z up, metres, the origin at its centre), with the
    colours of one time; the mask `invented` (n,) has those of sides that no camera saw. `size` is length, width and
    height in metres. `seen` are the directions, radians to the left of its front, from which training images show it
    (none: unknown). `source` says where it comes from: dataset, scene, method and track, as far as they are known;
    `quality`, the figures of its pixels in held-out images; `ground`, the colour of the ground about it there, RGB in
    [0, 1] (None: unknown).
    """

    name: str
    object_class: ObjectClass
    category: str
    size: Float[np.ndarray, "3"]
    gaussians: Gaussians
    invented: Bool[Tensor, " n"]
    gait: AssetGait | None = None
    seen: Float[np.ndarray, " s"] = field(default_factory=lambda: np.zeros(0))
    source: Mapping[str, str] = field(default_factory=dict)
    quality: Mapping[str, Any] = field(default_factory=dict)
    ground: Float[np.ndarray, "3"] | None = None
    provenance: Provenance = field(default_factory=dict)
    digest: str = ""
    """The SHA-256 of the file of its Gaussians, where it was read from one."""

    def record(self) -> dict[str, Any]:
        """What the asset is, as plain data, without its Gaussians and its provenance."""
        colors = 0.5 + SH_C0 * self.gaussians.sh0[:, 0]
        weights = (self.gaussians.opacities * self.gaussians.scales.amax(dim=1).square())[:, None]
        logits = self.gaussians.lidar_logits
        gait = self.gait
        return {
            "schema": SCHEMA,
            "name": self.name,
            "frame": FRAME,
            "class": self.object_class.value,
            "category": self.category,
            "size": np.asarray(self.size).tolist(),
            "gaussians": len(self.gaussians),
            "invented": int(self.invented.sum()),
            "sh_degree": self.gaussians.sh_degree,
            "mean_color": ((colors * weights).sum(dim=0) / weights.sum().clamp(min=1e-12)).tolist(),
            "seen": np.asarray(self.seen).round(4).tolist(),
            "lidar": None if logits is None else [float(value) for value in logits[:, 0].mean(dim=0)],
            "gait": None if gait is None else _gait_record(gait),
            "quality": dict(self.quality),
            "source": dict(self.source),
            "ground_color": None if self.ground is None else np.asarray(self.ground).round(4).tolist(),
        }


@dataclass(frozen=True, eq=False)
class Inserts:
    """What an edit inserts: the `assets` by the names that its steps have for them, and the `light` of the scene, which
    their shadows follow."""

    assets: Mapping[str, Asset]
    light: SceneLight = OVERCAST


NO_INSERTS = Inserts(MappingProxyType({}))


def write_asset(folder: Path, asset: Asset) -> dict[str, Any]:
    """Writes the files of an asset into its folder; returns the record."""
    folder.mkdir(parents=True, exist_ok=True)
    extra, record = extra_columns(asset.gaussians, asset.invented), asset.record()
    write_splat_ply(folder / PLY, asset.gaussians, {"asset": asset.name, "frame": "object"}, extra)
    write_json(folder / RECORD, {**record, "provenance": asset.provenance})
    return record


def extra_columns(gaussians: Gaussians, invented: Bool[Tensor, " n"]) -> dict[str, np.ndarray]:
    """The columns (n,) of asset.ply that other splats lack, by name: `invented`, and LiDAR logits where known."""
    extra = {INVENTED: invented.cpu().numpy().astype(np.uint8)}
    logits = gaussians.lidar_logits
    if logits is not None:
        values = logits.reshape(len(gaussians), 8).detach().cpu().numpy().astype(np.float32)
        extra |= dict(zip(LIDAR, values.T, strict=True))
    return extra


def read_asset(folder: Path) -> Asset:
    """Reads an asset's folder. Raises ResultError, which names the file, where a file is missing or is not one of an
    asset: of another version, in another frame, too large, or of a size that its class does not have."""
    path = folder / RECORD
    if not path.is_file():
        raise ResultError(f"{folder} is not an asset: it has no {RECORD}")
    try:
        record = read_json(path, "actor_assets")
        if not isinstance(record, dict) or record.get("schema") != SCHEMA:
            version = record.get("schema") if isinstance(record, dict) else None
            raise ValueError(f"its schema is {version!r}, not {SCHEMA}; make the asset again")
        if record.get("frame") != FRAME:
            raise ValueError(f"it does not declare the frame {json.dumps(FRAME)}")
        object_class = ObjectClass(record["class"])
        size = np.array(record["size"], dtype=np.float64)
        if fault := size_fault(object_class, size):
            raise ValueError(fault)
        gait = None if record["gait"] is None else _read_gait(record["gait"])
        about = {key: dict(record[key]) for key in ("quality", "source", "provenance")}
        seen = np.array(record["seen"], dtype=np.float64).reshape(-1)
        if not np.isfinite(seen).all():
            raise ValueError("its directions 'seen' contain NaN or Inf")
        ground = None if record["ground_color"] is None else np.array(record["ground_color"], dtype=np.float64)
        if ground is not None and (ground.shape != (3,) or not np.isfinite(ground).all()):
            raise ValueError("its ground_color is not three numbers")
        named = str(record["name"]), object_class, str(record["category"]), size
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        why = f"it lacks {error}" if isinstance(error, KeyError) else str(error).splitlines()[0]
        if isinstance(error, ValidationError):
            why = "; ".join(f"{'.'.join(map(str, one['loc']))}: {one['msg']}" for one in error.errors())
        raise ResultError(f"{path}: not an asset: {why}") from error
    gaussians, invented = read_gaussians(folder / PLY)
    return Asset(*named, gaussians, invented, gait, seen, **about, ground=ground, digest=sha256_file(folder / PLY))


def read_gaussians(path: Path) -> tuple[Gaussians, Bool[Tensor, " n"]]:
    """The Gaussians of an asset, and which of them are invented. Raises ResultError for a file that is no splat, or has
    more than MAX_GAUSSIANS."""
    gaussians = read_splat_ply(path)
    if not 0 < len(gaussians) <= MAX_GAUSSIANS:
        raise ResultError(f"{path}: it has {len(gaussians):,} Gaussians; an asset has 1 to {MAX_GAUSSIANS:,}")
    vertices = read_ply_data(path)["vertex"]
    known = {prop.name for prop in vertices.properties}
    invented = torch.zeros(len(gaussians), dtype=torch.bool)
    if INVENTED in known:
        invented = torch.from_numpy(np.asarray(vertices[INVENTED]) != 0)
    if known.issuperset(LIDAR):
        values = np.stack([np.asarray(vertices[name], dtype=np.float32) for name in LIDAR], axis=1)
        if not np.isfinite(values).all():
            raise ResultError(f"{path}: lidar_0 to lidar_7 contain NaN or Inf")
        logits = torch.from_numpy(values).reshape(len(gaussians), 4, 2)
        gaussians = Gaussians(**{**gaussians.tensors, "lidar_logits": logits})
    return gaussians, invented


def size_fault(object_class: ObjectClass, size: np.ndarray) -> str | None:
    """What a box of this class does not have; None without a fault."""
    if size.shape != (3,) or not np.isfinite(size).all():
        return f"its size {size.tolist()} is not three numbers"
    longest = MAX_OF_PEOPLE if object_class.is_human else MAX_EDGE
    if (size < MIN_EDGE).any() or (size > longest).any():
        edges = " x ".join(f"{edge:g}" for edge in size)
        return f"its box of {edges} m does not fit its class {object_class.value!r} ({MIN_EDGE:g} to {longest:g} m)"
    return None


def _gait_record(gait: AssetGait) -> dict[str, Any]:
    settings = {"gait": gait.settings.model_dump(mode="json"), "lattice": gait.lattice.model_dump(mode="json")}
    return {"cycle_m": gait.cycle, **settings, "nodes": gait.nodes.double().cpu().numpy().round(7).tolist()}


def _read_gait(record: Mapping[str, Any]) -> AssetGait:
    settings = GaitSettings.model_validate(record["gait"])
    lattice = LatticeSettings.model_validate(record["lattice"])
    nodes = torch.tensor(record["nodes"], dtype=torch.float32)
    cycle = float(record["cycle_m"])
    if tuple(nodes.shape) != (2 * settings.harmonics, *lattice.nodes, 6) or not bool(torch.isfinite(nodes).all()):
        raise ValueError("the nodes of its gait do not fit its lattice")
    if not 0.05 <= cycle <= 100.0:
        raise ValueError(f"a cycle of its gait is {cycle:g} m long")
    return AssetGait(cycle, settings, lattice, nodes)
