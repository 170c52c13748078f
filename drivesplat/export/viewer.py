"""The stage `export_viewer`: a trained model as viewer.html, one page that needs a browser and no network.

The page uses the WebGL 2 code in `viewer_page/`, which projects, culls and colours as gsplat does, including spherical
harmonics, and shows the learned sky. The page contains no addresses, and its content security policy prevents requests.

The payload is base64 of zlib-compressed little-endian arrays, each at a multiple of 4 bytes, listed in the JSON of
#scene. Coefficients of spherical harmonics beyond the first are `sh_range` t |t| with t the
stored byte over 127, finest where most of them are: near zero.
"""

import base64
import logging
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from drivesplat.export import viewer_page as template
from drivesplat.export.thinning import thinned
from drivesplat.export.trained_parts import trained_gaussians
from drivesplat.io.html_page import filled_page
from drivesplat.io.storage import Provenance, atomic_write
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Sky
from drivesplat.rendering.color_bytes import to_uint8
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.scene import Frame, Scene
from drivesplat.settings.export import ExportJob

log = logging.getLogger(__name__)

SKY_SIZE = 256
"""Texels along an edge of the sky's cube map."""


def export_viewer(
    path: str | Path,
    checkpoint: TrainedCheckpoint,
    scene: Scene,
    job: ExportJob,
    method: str,
    provenance: Provenance,
) -> None:
    """Writes the page with the `job.gaussians` Gaussians of a checkpoint that have the largest coverage,
    viewed from `job.eval_camera`.

    Objects are shown at the time of the drive's middle image. Raises DatasetError if the scene has no key frame of that
    camera.
    """
    start = scene.frames[scene.middle_key_frame(job.eval_camera)]
    model = trained_model(checkpoint)
    gaussians = trained_gaussians(model, scene)
    kept = thinned(gaussians, job.gaussians)
    page = viewer_page(kept, model.sky, model.antialiased, start, f"{scene.name} · {method}", provenance)
    with atomic_write(path) as file:
        file.write(page.encode())
    log.info("%d of %d Gaussians, %.1f MB", len(kept), len(gaussians), len(page) * 1e-6)


def viewer_page(
    gaussians: Gaussians, sky: Sky | None, antialiased: bool, start: Frame, title: str, provenance: Provenance
) -> str:
    """The text of the page, deterministic. Its first view is that of `start`; without a sky the background is black."""
    arrays, sh_range = splat_arrays(gaussians)
    layout, payload = packed({**arrays, "sky": sky_faces(sky, SKY_SIZE)})
    scene = {
        "count": len(gaussians),
        "coefficients": 1 + gaussians.shN.shape[1],
        "antialiased": antialiased,
        "sh_range": sh_range,
        "sky_size": SKY_SIZE,
        "start": start_pose(start),
        "arrays": layout,
    }
    encoded = base64.b64encode(payload).decode()
    return filled_page(template, title=title, provenance=provenance, scene=scene, payload=encoded)


def splat_arrays(gaussians: Gaussians) -> tuple[dict[str, np.ndarray], float]:
    """The Gaussians in the page's encoding, and the largest coefficient of spherical harmonics beyond the first.

    `means` (n, 3) float32 and `scales` (n, 3) float16 in metres, unit `quats` (n, 4) float16, `opacities` (n,) uint8,
    `sh0` (n, 3) float16, `shN` (n, k - 1, 3) int8.
    """
    shN = gaussians.shN.float()
    sh_range = float(shN.abs().max()) if shN.numel() else 0.0
    roots = torch.sign(shN) * torch.sqrt(shN.abs() / (sh_range or 1.0))
    largest = torch.finfo(torch.float16).max
    arrays = {
        "means": gaussians.means.float(),
        "scales": gaussians.scales.clamp(max=largest).half(),
        "quats": torch.nn.functional.normalize(gaussians.quats.float(), dim=-1).half(),
        "opacities": torch.round(gaussians.opacities * 255.0).to(torch.uint8),
        "sh0": gaussians.sh0[:, 0].clamp(-largest, largest).half(),
        "shN": torch.round(roots * 127.0).to(torch.int8),
    }
    return {name: array.detach().contiguous().numpy() for name, array in arrays.items()}, sh_range


@torch.no_grad()
def sky_faces(sky: Sky | None, size: int) -> np.ndarray:
    """The sky (6, size, size, 3) uint8 as an OpenGL cube map in world directions: faces +x -x +y -y +z -z."""
    if sky is None:
        return np.zeros((6, size, size, 3), np.uint8)
    return torch.stack([to_uint8(sky.colors(rays)) for rays in cube_rays(size)]).numpy()


def cube_rays(size: int) -> Float[Tensor, "6 size size 3"]:
    """Unit directions of a cube map's texels (face, t, s): OpenGL 4.5 specification, table of section 8.13."""
    line = (torch.arange(size) + 0.5) * (2.0 / size) - 1.0
    t, s = torch.meshgrid(line, line, indexing="ij")
    one = torch.ones_like(s)
    faces = [(one, -t, -s), (-one, -t, s), (s, one, t), (s, -one, -t), (s, -t, one), (-s, -t, -one)]
    return torch.nn.functional.normalize(torch.stack([torch.stack(face, dim=-1) for face in faces]), dim=-1)


def start_pose(frame: Frame) -> dict[str, Any]:
    """The camera of a recorded frame: `K` in continuous pixels of width x height, OpenCV `camera_to_world` (4, 4)."""
    return {
        "width": frame.width,
        "height": frame.height,
        "K": continuous_intrinsics(frame, (frame.width, frame.height)).tolist(),
        "camera_to_world": frame.camera_to_world.tolist(),
    }


def packed(arrays: dict[str, np.ndarray]) -> tuple[list[dict[str, Any]], bytes]:
    """The offset (bytes) and length (values) of each array, and all arrays compressed with zlib."""
    layout, content = [], bytearray()
    for name, array in arrays.items():
        content.extend(bytes(-len(content) % 4))
        layout.append({"name": name, "dtype": array.dtype.name, "offset": len(content), "length": array.size})
        content.extend(array.astype(array.dtype.newbyteorder("<")).tobytes())
    return layout, zlib.compress(bytes(content), level=9)
