"""The stage `export_usd`: a trained model with its moving objects and the recorded camera as scene.usdz, for programs
with OpenUSD.

The stage: metres, z up, the world of `Scene` with its origin in customLayerData, thirty time codes a second since the
first image. Its prims:

- one for every static group, such as /World/background
- /World/actors/{track} for every object: Gaussians in the object's frame, transform and visibility over time, and for
  an object that deforms also positions and orientations of its Gaussians
- /World/camera with the recorded path

The schema of Gaussians (usd-core 26.11) requires linear values: opacities in [0, 1], scales in metres, unit
quaternions, and for every Gaussian its RGB coefficients of spherical harmonics in the order of 3D Gaussian Splatting,
all in the local space of the prim. Colours are those of `export.time_s` at all times. The sky consists of no Gaussians
and is not included; the schema has no attribute for antialiased training.
"""

import logging
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdVol, Vt
from torch import Tensor

from drivesplat.export.sampled_motion import SAMPLES_PER_SECOND, SampledShapes
from drivesplat.export.thinning import thinned_groups
from drivesplat.export.trained_parts import SampledGroup, digests, trained_groups
from drivesplat.io.storage import Provenance, atomic_path, unwritable
from drivesplat.io.unique_names import unique_names
from drivesplat.model.checkpoint import TrainedCheckpoint, trained_model
from drivesplat.model.gaussians import Gaussians
from drivesplat.scene.images import continuous_intrinsics
from drivesplat.scene.scene import Scene
from drivesplat.settings.export import ExportJob
from drivesplat.trajectories.camera_path import recorded_frames, recorded_timestamps, sampled_path

log = logging.getLogger(__name__)
APERTURE_WIDTH = 0.36
"""A sensor width of 36 mm in the lens unit of UsdGeom.Camera: a tenth of the scene's unit, here 10 cm."""
CLIPPING_RANGE = (0.1, 10_000.0)
"""Metres."""
_ACTORS, _CAMERA = "/World/actors", "/World/camera"
_OPENCV_TO_USD = np.diag([1.0, -1.0, -1.0, 1.0])
"""USD cameras look along -z with y up, OpenCV cameras along z with y down."""
TIME_CODES_PER_SECOND = float(SAMPLES_PER_SECOND)
EXTENT_SIGMAS = 3.0
"""The radius of a Gaussian in the extent, in units of its largest scale: the kernel's support in the schema."""


def export_usd(
    path: str | Path, checkpoint: TrainedCheckpoint, scene: Scene, job: ExportJob, provenance: Provenance
) -> None:
    """Writes the `job.gaussians` Gaussians of a checkpoint with the largest coverage, and the recorded
    `job.eval_camera`. Raises DatasetError if the scene lacks that camera."""
    model = trained_model(checkpoint)
    cameras = recorded_cameras(scene, job.eval_camera)
    groups = trained_groups(model, scene, recorded_timestamps(scene, job.eval_camera), job.time_s)
    kept = thinned_groups(groups, job.gaussians)
    note = {"scene": scene.name, "dataset": scene.dataset, "origin": Gf.Vec3d(*scene.origin), **digests(provenance)}
    write_usdz(path, splat_stage(kept, cameras, note))
    before, after = (sum(len(group.gaussians) for group in of.values()) for of in (groups, kept))
    log.info("%d of %d Gaussians, %d groups, %d poses of %s", after, before, len(kept), len(cameras), job.eval_camera)


def recorded_cameras(scene: Scene, camera: str) -> list[tuple[float, Gf.Camera]]:
    """The USD cameras along a camera's recorded path, each with its time in seconds since the scene's first image.

    Images have their own poses; between them the path is that of films, sampled densely enough for USD, which
    interpolates matrices entry by entry. Raises DatasetError if the camera has no images.
    """
    times, poses = sampled_path(scene, camera, int(TIME_CODES_PER_SECOND))
    first = recorded_frames(scene, camera)[0]
    size = (first.width, first.height)
    K = continuous_intrinsics(first, size)
    return [(scene.seconds(time), usd_camera(K, size, pose)) for time, pose in zip(times, poses, strict=True)]


def splat_stage(
    groups: Mapping[str, SampledGroup], cameras: Sequence[tuple[float, Gf.Camera]], note: Mapping[str, Any]
) -> Usd.Stage:
    """A stage in memory with the groups by name, the camera at its times (seconds), unless there are none, and `note`
    in customLayerData."""
    stage = world_stage(note)
    static = [name for name, group in groups.items() if group.motion is None]
    objects = [name for name in groups if name not in static]
    if objects:
        Usd.ModelAPI(UsdGeom.Xform.Define(stage, _ACTORS)).SetKind(Kind.Tokens.group)
    taken = [path.rpartition("/")[2] for path in (_ACTORS, _CAMERA)]
    paths = {name: f"/World/{word}" for name, word in unique_names(static, identifier, taken).items()}
    paths |= {name: f"{_ACTORS}/{word}" for name, word in unique_names(objects, identifier).items()}
    for name, group in groups.items():
        define_group(stage, paths[name], name, group)
    if cameras:
        define_camera(stage, cameras)
    return stage


def world_stage(note: Mapping[str, Any]) -> Usd.Stage:
    """A stage in memory whose only prim is /World: metres, z up, TIME_CODES_PER_SECOND."""
    # its payloads lie beside the file that it becomes: in memory they would not be found
    stage = Usd.Stage.CreateInMemory("scene.usdc", Usd.Stage.LoadNone)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, UsdGeom.LinearUnits.meters)
    world = UsdGeom.Xform.Define(stage, "/World")
    Usd.ModelAPI(world).SetKind(Kind.Tokens.assembly)
    stage.SetDefaultPrim(world.GetPrim())
    stage.GetRootLayer().customLayerData = {"drivesplat": dict(note)}
    stage.SetTimeCodesPerSecond(TIME_CODES_PER_SECOND)
    stage.SetFramesPerSecond(TIME_CODES_PER_SECOND)
    return stage


def define_camera(stage: Usd.Stage, cameras: Sequence[tuple[float, Gf.Camera]]) -> None:
    """Defines /World/camera at its times (seconds), from the first to the last of which the stage plays."""
    camera = UsdGeom.Camera.Define(stage, _CAMERA)
    codes = [seconds * TIME_CODES_PER_SECOND for seconds, _ in cameras]
    stage.SetStartTimeCode(min(codes))
    stage.SetEndTimeCode(max(codes))
    for code, (_, recorded) in zip(codes, cameras, strict=True):
        camera.SetFromCamera(recorded, code)


def usd_camera(K: np.ndarray, size: tuple[int, int], camera_to_world: np.ndarray) -> Gf.Camera:
    """The camera of an image: `K` (3, 3) in continuous pixels at `size` (width, height), OpenCV pose (4, 4) in metres.

    The frustum is that of K: a principal point off the image centre becomes an aperture offset.
    """
    width, height = size
    focal_length = APERTURE_WIDTH * K[0, 0] / width
    return Gf.Camera(
        transform=usd_matrix(camera_to_world @ _OPENCV_TO_USD),
        horizontalAperture=APERTURE_WIDTH,
        verticalAperture=focal_length * height / K[1, 1],
        horizontalApertureOffset=focal_length * (width / 2 - K[0, 2]) / K[0, 0],
        verticalApertureOffset=focal_length * (K[1, 2] - height / 2) / K[1, 1],
        focalLength=focal_length,
        clippingRange=Gf.Range1f(*CLIPPING_RANGE),
    )


def write_usdz(path: str | Path, stage: Usd.Stage) -> None:
    """Packs a stage without dependencies into one file with the root layer scene.usdc.

    Raises ResultError naming the file if it cannot be written; no partial file remains.
    """
    path = Path(path)
    with atomic_path(path) as aside, tempfile.TemporaryDirectory(dir=path.parent, prefix=f".{path.stem}.") as folder:
        layer = Path(folder) / "scene.usdc"
        _require_written(path, lambda: stage.GetRootLayer().Export(str(layer)))
        _require_written(path, lambda: UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(layer)), str(aside)))


def write_layer(path: str | Path, stage: Usd.Stage) -> None:
    """Writes the root layer of a stage, as text (.usda) or binary (.usdc). Raises as `write_usdz`."""
    with atomic_path(path) as aside:
        _require_written(Path(path), lambda: stage.GetRootLayer().Export(str(aside)))


def _require_written(path: Path, write: Callable[[], bool]) -> None:
    """Calls `write`. Raises ResultError naming the file where it fails."""
    try:
        written = write()
    except Tf.ErrorException as error:
        raise unwritable(path, error.args[0].commentary) from error
    if not written:
        raise unwritable(path, "OpenUSD gives no reason")


def identifier(name: str) -> str:
    """A name as a USD identifier; a leading digit gets an underscore before it instead of being replaced by one."""
    return Tf.MakeValidIdentifier(f"_{name}" if name[:1].isdigit() else name)


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
