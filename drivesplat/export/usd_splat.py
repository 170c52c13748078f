"""Gaussians as a prim of OpenUSD's schema for Gaussian splats, with an object's motion as transforms over time.

The schema (usd-core 26.11) requires linear values: opacities in [0, 1], scales in metres, unit quaternions, and for
every Gaussian its RGB coefficients of spherical harmonics in the order of 3D Gaussian Splatting, all in the local space
of the prim: an object's Gaussians are constant in its frame, and the prim's transform moves them. Those of an object
that deforms have positions and orientations over time.
"""

import numpy as np
import torch
from jaxtyping import Float
from pxr import Gf, Kind, Usd, UsdGeom, UsdVol, Vt
from torch import Tensor

from drivesplat.export.sampled_motion import SAMPLES_PER_SECOND, SampledShapes
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.model.gaussians import Gaussians

TIME_CODES_PER_SECOND = float(SAMPLES_PER_SECOND)
EXTENT_SIGMAS = 3.0
"""The radius of a Gaussian in the extent, in units of its largest scale: the kernel's support in the schema."""


def define_group(stage: Usd.Stage, prim_path: str, name: str, group: SampledGroup) -> None:
    """Defines a ParticleField3DGaussianSplat at `prim_path`; a moving one also has its track, class and size, and its
    transform (object to world) and visibility over time."""
    splat, gaussians = UsdVol.ParticleField3DGaussianSplat.Define(stage, prim_path), group.gaussians
    Usd.ModelAPI(splat).SetKind(Kind.Tokens.component)
    splat.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(_numpy(gaussians.means)))
    splat.CreateOrientationsAttr(_orientations(torch.nn.functional.normalize(gaussians.quats, dim=-1)))
    splat.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(_numpy(gaussians.scales)))
    splat.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(_numpy(gaussians.opacities)))
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(_numpy(gaussians.sh.reshape(-1, 3))))
    # as gsplat renders in training
    splat.CreateProjectionModeHintAttr(UsdVol.Tokens.perspective)
    splat.CreateSortingModeHintAttr(UsdVol.Tokens.zDepth)
    if len(gaussians):
        splat.CreateExtentAttr(_extent(gaussians.means, gaussians.scales))
    motion = group.motion
    if motion is None:
        return
    about = {"track": name}
    if group.track is not None:
        about |= {"category": group.track.category, "size": Gf.Vec3d(*group.track.size)}
    splat.GetPrim().SetCustomDataByKey("drivesplat", about)
    splat.GetPrim().SetDisplayName(" ".join([about.get("category", "object"), name]))
    transform = splat.AddTransformOp()
    transform.Set(usd_matrix(motion.default_pose))
    for code, pose in zip(motion.seconds * TIME_CODES_PER_SECOND, motion.object_to_world, strict=True):
        transform.Set(usd_matrix(pose), float(code))
    # USD holds a token until the next sample, and the first also before it
    visibility = splat.CreateVisibilityAttr(_visibility(motion.present_by_default))
    visibility.Set(_visibility(False), motion.spans[0][0] * TIME_CODES_PER_SECOND - 1.0)
    for first, last in motion.spans:
        visibility.Set(_visibility(True), first * TIME_CODES_PER_SECOND)
        visibility.Set(_visibility(False), float(np.nextafter(last * TIME_CODES_PER_SECOND, np.inf)))
    if group.shapes is not None and len(gaussians):
        _set_shapes(splat, gaussians, group.shapes)


def usd_matrix(transform: np.ndarray) -> Gf.Matrix4d:
    """A transform (4, 4) for column vectors as a USD matrix, which is for row vectors."""
    return Gf.Matrix4d(transform.T.tolist())


def _set_shapes(splat: UsdVol.ParticleField3DGaussianSplat, gaussians: Gaussians, shapes: SampledShapes) -> None:
    """Positions, orientations and extent over time; their default values are those of the default time."""
    positions, orientations, extent = splat.GetPositionsAttr(), splat.GetOrientationsAttr(), splat.GetExtentAttr()
    codes = (shapes.seconds * TIME_CODES_PER_SECOND).tolist()
    for code, means, quats in zip(codes, map(torch.from_numpy, shapes.means), shapes.quats, strict=True):
        positions.Set(Vt.Vec3fArray.FromNumpy(_numpy(means)), code)
        orientations.Set(_orientations(torch.from_numpy(quats)), code)
        extent.Set(_extent(means, gaussians.scales), code)


def _orientations(quats: Float[Tensor, "n 4"]) -> Vt.QuatfArray:
    """Unit quaternions w, x, y, z; the memory layout of Gf.Quatf is x, y, z, w."""
    return Vt.QuatfArray.FromNumpy(_numpy(quats.roll(-1, dims=-1)))


def _extent(means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"]) -> Vt.Vec3fArray:
    """The corners of a box around Gaussians in their own frame, which usd-core does not compute for this schema."""
    reach = EXTENT_SIGMAS * scales.amax(dim=-1, keepdim=True)
    corners = torch.stack([(means - reach).amin(dim=0), (means + reach).amax(dim=0)])
    return Vt.Vec3fArray.FromNumpy(_numpy(corners))


def _visibility(present: bool) -> str:
    return UsdGeom.Tokens.inherited if present else UsdGeom.Tokens.invisible


def _numpy(values: Tensor) -> np.ndarray:
    return values.detach().cpu().float().contiguous().numpy()
