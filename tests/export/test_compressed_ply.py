"""PlayCanvas' .compressed.ply: packed here bit by bit, and unpacked."""

import numpy as np
import pytest
from helpers import REPOSITORY
from plyfile import PlyData, PlyElement

from drivesplat.errors import ResultError
from drivesplat.export.splat_ply import read_splat_ply

COUNT = 300
"""More than one chunk."""


def pack(values: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Values (n, k) in [0, 1] as fields of these widths, the first in the highest bits."""
    packed = np.zeros(len(values), dtype=np.uint64)
    for column, width in zip(values.T, bits, strict=True):
        packed = (packed << np.uint64(width)) | np.round(column * (2**width - 1)).astype(np.uint64)
    return packed.astype(np.uint32)


def packed_file(path, colors: bool, degree: int) -> dict[str, np.ndarray]:
    """Writes random Gaussians; returns them."""
    random = np.random.default_rng(0)
    given = {
        "means": random.uniform(-20.0, 20.0, (COUNT, 3)), "scales": random.uniform(-5.0, 0.0, (COUNT, 3)),
        "rgb": random.uniform(-0.5 if colors else 0.0, 1.5 if colors else 1.0, (COUNT, 3)),
        "opacities": np.append(random.uniform(0.0, 1.0, COUNT - 2), [0.0, 1.0]),
        "rest": random.uniform(-3.0, 3.0, (COUNT, 3 * ((degree + 1) ** 2 - 1))),
    }  # fmt: skip
    quats = random.normal(size=(COUNT, 4))
    given["quats"] = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    chunk_rows, parts = [], {name: [] for name in ("means", "scales", "rgb")}
    for begin in range(0, COUNT, 256):
        bounds = []
        for name in parts:
            piece = given[name][begin : begin + 256]
            low, high = piece.min(axis=0), piece.max(axis=0)
            if name == "rgb" and not colors:
                low, high = np.zeros(3), np.ones(3)
            parts[name].append((piece - low) / (high - low))
            bounds += [*low, *high]
        chunk_rows.append(tuple(bounds[: 18 if colors else 12]))
    unit = {name: np.concatenate(pieces) for name, pieces in parts.items()}
    rotation = np.zeros(COUNT, dtype=np.uint32)
    for i, quat in enumerate(given["quats"]):
        largest = int(np.argmax(np.abs(quat)))
        others = np.delete(quat * np.sign(quat[largest]), largest) / np.sqrt(2.0) + 0.5
        rotation[i] = (largest << 30) | int(pack(others[None], (10, 10, 10))[0])
    names = [
        f"{side}_{axis}" for kind in ("{}", "scale_{}") for side in ("min", "max") for axis in map(kind.format, "xyz")
    ]
    names += [f"{side}_{axis}" for side in ("min", "max") for axis in "rgb"] if colors else []
    vertices = np.zeros(COUNT, dtype=[(f"packed_{n}", "<u4") for n in ("position", "rotation", "scale", "color")])
    vertices["packed_position"], vertices["packed_rotation"] = pack(unit["means"], (11, 10, 11)), rotation
    vertices["packed_scale"] = pack(unit["scales"], (11, 10, 11))
    vertices["packed_color"] = pack(np.column_stack([unit["rgb"], given["opacities"]]), (8, 8, 8, 8))
    elements = [
        PlyElement.describe(np.array(chunk_rows, dtype=[(name, "<f4") for name in names]), "chunk"),
        PlyElement.describe(vertices, "vertex"),
    ]
    if degree:
        rest = np.round((given["rest"] + 4.0) / 8.0 * 255.0).astype(np.uint8)
        kinds = [(f"f_rest_{i}", "u1") for i in range(rest.shape[1])]
        elements.append(PlyElement.describe(np.array([tuple(row) for row in rest], dtype=kinds), "sh"))
    PlyData(elements, byte_order="<").write(str(path))
    return given


@pytest.mark.parametrize(("colors", "degree"), [(True, 0), (False, 0), (True, 1), (True, 3)])
def test_packed_gaussians_are_read_to_their_precision(colors, degree, tmp_path):
    given = packed_file(tmp_path / "a.compressed.ply", colors, degree)
    read = read_splat_ply(tmp_path / "a.compressed.ply")
    np.testing.assert_allclose(read.means, given["means"], atol=0.55 * 40.0 / 1023)
    np.testing.assert_allclose(np.log(read.scales), given["scales"], atol=0.55 * 5.0 / 1023)
    same = np.abs((read.quats.numpy() * given["quats"]).sum(axis=1))
    assert same.min() > 0.999995, "the same rotation, whatever its sign"
    np.testing.assert_allclose(read.opacities, given["opacities"], atol=0.51 / 255)
    assert read.opacities[-1] == 1.0
    np.testing.assert_allclose(0.5 + 0.28209479 * read.sh0[:, 0].numpy(), given["rgb"], atol=0.55 * 2.0 / 255)
    assert read.sh_degree == degree
    channels = given["rest"].reshape(COUNT, 3, -1).transpose(0, 2, 1)
    np.testing.assert_allclose(read.shN, channels, atol=0.51 * 8.0 / 255)


def test_a_file_with_too_few_chunks_is_refused(tmp_path):
    packed_file(tmp_path / "a.compressed.ply", True, 0)
    data = PlyData.read(str(tmp_path / "a.compressed.ply"))
    PlyData([PlyElement.describe(data["chunk"].data[:1], "chunk"), data["vertex"]]).write(str(tmp_path / "b.ply"))
    with pytest.raises(ResultError, match="1 chunks for 300 Gaussians"):
        read_splat_ply(tmp_path / "b.ply")


def test_a_trained_file_of_another_program_is_read():
    path = REPOSITORY.parent / "shared/data/splats-by-others/guitar.compressed.ply"
    if not path.is_file():
        pytest.skip(f"no compressed splat of another program at {path}")
    read = read_splat_ply(path)
    assert len(read) == 90_854 and (read.opacities == 1.0).sum() == 667
    np.testing.assert_allclose(np.linalg.norm(read.quats, axis=1), 1.0, atol=1e-5)
