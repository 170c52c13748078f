"""Gaussians placed at random before a camera."""

from dataclasses import dataclass, fields, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from drivesplat.rasterization import Rendering
from helpers.reference_rasterizer import rasterize_reference


@dataclass
class Scene:
    """n Gaussians and C cameras."""

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    colors: torch.Tensor
    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int

    def render(self, **options) -> Rendering:
        return rasterize_reference(**{f.name: getattr(self, f.name) for f in fields(self)}, **options)

    def float(self) -> "Scene":
        """The scene in float32."""
        tensors = {f.name: getattr(self, f.name).float() for f in fields(self) if f.type is torch.Tensor}
        return replace(self, **tensors)


def random_scene(seed: int, n: int, width: int, height: int, cameras: int = 1) -> Scene:
    """Anisotropic Gaussians before cameras at different places; some reach over the images' borders."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(2.0, 8.0, n)
    x, y = rng.uniform(-0.9, 0.9, n) * depth, rng.uniform(-0.6, 0.6, n) * depth
    viewmats = np.tile(np.eye(4), (cameras, 1, 1))
    viewmats[:, :3, :3] = Rotation.from_euler("xyz", rng.uniform(-0.15, 0.15, (cameras, 3))).as_matrix()
    viewmats[:, :3, 3] = rng.uniform(-0.5, 0.5, (cameras, 3))
    focal = 0.7 * width
    intrinsics = np.array([[focal, 0.0, 0.48 * width], [0.0, 1.1 * focal, 0.53 * height], [0.0, 0.0, 1.0]])
    arrays = {
        "means": np.stack([x, y, depth], axis=1),
        "quats": rng.normal(size=(n, 4)),
        "scales": np.exp(rng.uniform(-3.0, -0.5, (n, 3))),
        "opacities": rng.uniform(0.02, 1.0, n),
        "colors": rng.uniform(0.0, 1.0, (n, 3)),
        "viewmats": viewmats,
        "Ks": np.tile(intrinsics, (cameras, 1, 1)),
    }
    return Scene(**{name: torch.from_numpy(value) for name, value in arrays.items()}, width=width, height=height)
