"""Gaussians and the recording camera as scene.usdz, in OpenUSD's own schema for Gaussian splats (usd-core 26.11).

The stage: metres, z up, the world of `Scene` with its origin in customLayerData. /World holds one
ParticleField3DGaussianSplat a part of the model, and /World/camera as it was recorded. The schema wants linear values:
opacities in [0, 1], scales in metres, unit quaternions, and for every Gaussian its RGB coefficients of spherical
harmonics in the order of 3D Gaussian Splatting. Moving parts stand where they are at the one time they are given for.
The sky is not a Gaussian and is not in here, nor can the schema say that a model was trained antialiased.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdVol, Vt
from torch import Tensor

from drivesplat.errors import ResultError
from drivesplat.model.gaussians import Gaussians
from drivesplat.storage import atomic_path

TIME_CODES_PER_SECOND = 30.0
APERTURE_WIDTH = 0.36
"""A sensor 36 mm wide in the unit that UsdGeom.Camera has for lenses: a tenth of the scene's unit, here 10 cm."""
CLIPPING_RANGE = (0.1, 10_000.0)
"""Metres."""
EXTENT_SIGMAS = 3.0
"""How far a Gaussian reaches for the extent, in its largest scale: the support that the schema gives the kernel."""
_OPENCV_TO_USD = np.diag([1.0, -1.0, -1.0, 1.0])
"""A USD camera looks along -z with y up, an OpenCV camera along z with y down."""


def splat_stage(
    parts: Mapping[str, Gaussians], cameras: Sequence[tuple[float, Gf.Camera]], note: Mapping[str, Any]
) -> Usd.Stage:
    """A stage in memory with the parts by name, the camera at its times (seconds) and `note` in customLayerData."""
    stage = Usd.Stage.CreateInMemory("scene.usdc")
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
    stage.GetRootLayer().customLayerData = {"drivesplat": dict(note)}
    for name, gaussians in parts.items():
        _define_splat(stage, f"/World/{Tf.MakeValidIdentifier(name)}", gaussians)
    _define_camera(stage, cameras)
    return stage


def usd_camera(K: np.ndarray, size: tuple[int, int], camera_to_world: np.ndarray) -> Gf.Camera:
    """The camera of an image: `K` (3, 3) in continuous pixels at `size` (width, height), OpenCV pose (4, 4) in metres.

    The frustum is that of K: with a principal point off the middle the aperture is off the lens's axis.
    """
    width, height = size
    focal_length = APERTURE_WIDTH * K[0, 0] / width
    return Gf.Camera(
        transform=Gf.Matrix4d((camera_to_world @ _OPENCV_TO_USD).T.tolist()),  # USD multiplies row vectors
        horizontalAperture=APERTURE_WIDTH,
        verticalAperture=focal_length * height / K[1, 1],
        horizontalApertureOffset=focal_length * (width / 2 - K[0, 2]) / K[0, 0],
        verticalApertureOffset=focal_length * (K[1, 2] - height / 2) / K[1, 1],
        focalLength=focal_length,
        clippingRange=Gf.Range1f(*CLIPPING_RANGE),
    )


def write_usdz(path: str | Path, stage: Usd.Stage) -> None:
    """Packs a stage without dependencies into one file, its root layer scene.usdc.

    Raises ResultError naming the file where it cannot be written; nothing is left of it then.
    """
    path = Path(path)
    with atomic_path(path) as aside, tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.") as folder:
        layer = Path(folder) / "scene.usdc"
        try:
            written = stage.GetRootLayer().Export(str(layer))
            written = written and UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(aside))
        except Tf.ErrorException as error:
            raise _unwritable(path, error.args[0].commentary) from error
        if not written:
            raise _unwritable(path, "OpenUSD gives no reason")


def _unwritable(path: Path, why: str) -> ResultError:
    return ResultError(f"{path}: cannot be written ({why}); free space or fix its permissions")


def _define_splat(stage: Usd.Stage, prim_path: str, gaussians: Gaussians) -> None:
    splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, prim_path)
    quats = torch.nn.functional.normalize(gaussians.quats, dim=-1)
    splat.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(_numpy(gaussians.means)))
    # the memory of Gf.Quatf is x, y, z, w
    splat.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(_numpy(quats.roll(-1, dims=-1))))
    splat.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(_numpy(gaussians.scales)))
    splat.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(_numpy(gaussians.opacities)))
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(_numpy(gaussians.sh.reshape(-1, 3))))
    # how gsplat rendered them in training
    splat.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    splat.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)
    if len(gaussians):
        splat.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_numpy(_extent(gaussians))))


def _extent(gaussians: Gaussians) -> Float[Tensor, "2 3"]:
    """The corners of a box around the Gaussians; usd-core computes none for this schema."""
    reach = EXTENT_SIGMAS * gaussians.scales.amax(dim=-1, keepdim=True)
    return torch.stack([(gaussians.means - reach).amin(dim=0), (gaussians.means + reach).amax(dim=0)])


def _define_camera(stage: Usd.Stage, cameras: Sequence[tuple[float, Gf.Camera]]) -> None:
    camera = UsdGeom.Camera.Define(stage, "/World/camera")
    stage.SetTimeCodesPerSecond(TIME_CODES_PER_SECOND)
    stage.SetFramesPerSecond(TIME_CODES_PER_SECOND)
    codes = [seconds * TIME_CODES_PER_SECOND for seconds, _ in cameras]
    stage.SetStartTimeCode(min(codes))
    stage.SetEndTimeCode(max(codes))
    for code, (_, recorded) in zip(codes, cameras, strict=True):
        camera.SetFromCamera(recorded, code)


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().float().contiguous().numpy()
