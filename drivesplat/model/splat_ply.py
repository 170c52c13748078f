"""Gaussians as splat.ply, in the layout of 3D Gaussian Splatting (Kerbl et al. 2023) that viewers read.

One vertex per Gaussian, all float32: x y z, nx ny nz (zeros), f_dc_0..2, f_rest_* (channel-major: every coefficient of
red, then of green, then of blue), opacity as its logit, scale_0..2 as logarithms of metres, rot_0..3 as a unit
quaternion w x y z. gsplat's exporter is not used: it omits the normals, so that SIBR reads every value with an offset
of three floats, supports no note, and drops every Gaussian if a single opacity is invalid.
"""

import json
import math
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
from plyfile import PlyData, PlyElement, PlyParseError

from drivesplat.errors import ResultError
from drivesplat.io.point_cloud import read_ply_data
from drivesplat.io.storage import atomic_write, canonical_json, unreadable
from drivesplat.model.compressed_ply import unpacked
from drivesplat.model.gaussians import Gaussians

_NOTE = "drivesplat "
_MAX_HEADER_BYTES = 10_000
TINY = torch.finfo(torch.float32).tiny
ALMOST_ONE = 1.0 - 2.0**-24
"""The float32 before 1: the largest opacity with a finite logit."""
NO_EXTRA: Mapping[str, np.ndarray] = MappingProxyType({})


def write_splat_ply(
    path: str | Path, gaussians: Gaussians, note: dict[str, Any], extra: Mapping[str, np.ndarray] = NO_EXTRA
) -> None:
    """Writes all of `gaussians`, with `note` as JSON in a comment of the header, and `extra` properties (n,) after the
    others.

    Opacities are clamped to values with a finite logit, quaternions are normalised. The note should not exceed 8 kB:
    antimatter15's viewer searches for the end of the header in the first 10 kB. Raises ResultError naming `path`.
    """
    count, coefficients = gaussians.shN.shape[:2]
    columns = [
        gaussians.means,
        torch.zeros(count, 3),
        gaussians.sh0[:, 0],
        gaussians.shN.transpose(1, 2).reshape(count, 3 * coefficients),
        torch.logit(gaussians.opacities.double().clamp(TINY, ALMOST_ONE))[:, None],
        torch.log(gaussians.scales.clamp_min(TINY)),
        torch.nn.functional.normalize(gaussians.quats, dim=-1),
    ]
    values = torch.cat([column.detach().cpu().float() for column in columns], dim=1)
    vertices = values.numpy().view([(name, "<f4") for name in _property_names(coefficients)])[:, 0]
    if extra:
        plain, more = vertices, [(name, values.dtype.str) for name, values in extra.items()]
        vertices = np.empty(count, dtype=[*plain.dtype.descr, *more])
        for name, values in (*((name, plain[name]) for name in plain.dtype.names), *extra.items()):
            vertices[name] = values
    # SIBR expects "element vertex" in the header's third line: the comment stands after it, as the element's own.
    element = PlyElement.describe(vertices, "vertex", comments=[_NOTE + canonical_json(note)])
    with atomic_write(path) as file:
        PlyData([element], byte_order="<").write(file)


def note_of(path: str | Path) -> dict[str, Any]:
    """The note in a file by `write_splat_ply`; empty for any other file."""
    with suppress(OSError, ValueError), open(path, "rb") as file:
        header = file.read(_MAX_HEADER_BYTES).partition(b"end_header")[0].decode("ascii", "replace")
        for line in header.splitlines():
            if line.startswith(f"comment {_NOTE}"):
                note = json.loads(line.removeprefix(f"comment {_NOTE}"))
                return note if isinstance(note, dict) else {}
    return {}


def read_splat_ply(path: str | Path, rule: str | None = None) -> Gaussians:
    """Reads a file of this convention, by `write_splat_ply` or another program, or a .compressed.ply of PlayCanvas, on
    the CPU. An opacity of ±Inf is 1 or 0.

    Raises ResultError naming the file if it is truncated, lacks a property, or contains NaN or Inf; with the advice to
    rebuild it for a file of a run, which is the output of `rule`, or has a note of `write_splat_ply`.
    """
    try:
        data = read_ply_data(path)
        if "vertex" in data and "packed_position" in data["vertex"]:
            return unpacked(data)
        vertices = data["vertex"]
        count = sum(p.name.startswith("f_rest_") for p in vertices.properties)
        coefficients = count // 3
        if count % 3 or math.isqrt(coefficients + 1) ** 2 != coefficients + 1:
            raise ValueError(f"{count} f_rest properties match no degree of spherical harmonics")
        names = _property_names(coefficients)
        columns = {name: np.asarray(vertices[name], dtype=np.float32) for name in names if name[0] != "n"}
        for name, column in columns.items():
            wrong = np.isnan(column) if name == "opacity" else ~np.isfinite(column)
            if wrong.any():
                raise ValueError(f"{name} is NaN or Inf in {wrong.sum()} of {len(column)} Gaussians")
        values = torch.from_numpy(np.stack(list(columns.values()), axis=1))
        means, sh0, rest, opacity, scales, quats = values.split([3, 3, count, 1, 3, 4], dim=1)
        shN = rest.reshape(len(values), 3, coefficients).transpose(1, 2)
        return Gaussians(means, quats, torch.exp(scales), torch.sigmoid(opacity[:, 0]), sh0[:, None], shN)
    except (OSError, PlyParseError, KeyError, ValueError, TypeError) as error:
        why = f"not a splat in the 3DGS convention ({error or type(error).__name__})"
        if rule or note_of(path):
            raise unreadable(path, rule or "export", why) from error
        raise ResultError(f"{path}: {why}") from error


def _property_names(coefficients: int) -> list[str]:
    """The properties in order, for this number of coefficients per channel beyond the first."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * coefficients)]
    return [*names, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
