"""Triangle meshes, and their binary PLY files."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """The `vertices` (metres) of a surface, and the three vertices of each of its `triangles`, counterclockwise seen
    from outside or above."""

    vertices: Float[np.ndarray, "v 3"]
    triangles: Int[np.ndarray, "t 3"]

    def __len__(self) -> int:
        return len(self.triangles)

    def with_triangles(self, kept: np.ndarray) -> "TriangleMesh":
        """The mesh of some of the triangles, (t,) bool or their indices, with the vertices that these have."""
        triangles = self.triangles[kept]
        used, numbers = np.unique(triangles, return_inverse=True)
        return TriangleMesh(self.vertices[used], numbers.reshape(-1, 3))


def ply_bytes(mesh: TriangleMesh) -> bytes:
    """The content of a PLY file, little-endian: vertices with x, y, z in single precision, and faces with
    vertex_indices."""
    lines = [
        "ply", "format binary_little_endian 1.0",
        f"element vertex {len(mesh.vertices)}", *(f"property float {axis}" for axis in "xyz"),
        f"element face {len(mesh)}", "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    faces = np.zeros(len(mesh), dtype=[("count", "u1"), ("vertices", "<i4", 3)])
    faces["count"], faces["vertices"] = 3, mesh.triangles
    return "\n".join([*lines, ""]).encode() + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()
