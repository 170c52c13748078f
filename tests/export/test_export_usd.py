"""scene.usdz as OpenUSD reads it again: Gaussians in the schema's terms, and the camera that recorded them."""

import dataclasses
import resource
import zipfile

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol
from scipy.spatial.transform import Rotation

from drivesplat.errors import ResultError
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.usd import export_usd, recorded_cameras, splat_stage, usd_camera, write_usdz
from drivesplat.model.background import Background
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import rigid
from drivesplat.settings.export import ExportJob
from drivesplat.settings.train import GaussianSettings, TrainJob, TrainSettings

COUNT, KEPT = 60, 40
PROVENANCE = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64, "stages": {}}


def random_splats(count: int = COUNT, sh_degree: int = 2, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)
    random = torch.rand(count, 8, generator=generator)
    quats = torch.randn(count, 4, generator=generator)
    sh = torch.randn(count, (sh_degree + 1) ** 2, 3, generator=generator)
    return Gaussians.of(20.0 * random[:, :3], quats, 0.01 + random[:, 3:6], 0.01 + 0.98 * random[:, 6], sh)


def oblique_camera() -> tuple[np.ndarray, tuple[int, int], np.ndarray]:
    """K with oblong pixels and its principal point off the middle, size, and a turned and moved pose."""
    K = np.array([[310.0, 0.0, 175.5], [0.0, 290.0, 81.25], [0.0, 0.0, 1.0]])
    turned = Rotation.from_euler("xyz", [-1.4, 0.1, 0.7]).as_matrix()
    return K, (320, 180), rigid(turned, np.array([5.0, -3.0, 1.6]))


@pytest.fixture(scope="module")
def checkpoint():
    splats = random_splats()
    settings = TrainSettings(gaussians=GaussianSettings(sh_degree=2))
    params = {
        "means": splats.means, "quats": splats.quats, "scales": torch.log(splats.scales),
        "opacities": torch.logit(splats.opacities), "sh0": splats.sh[:, :1], "shN": splats.sh[:, 1:],
    }  # fmt: skip
    model = SplatModel([Background(params, settings.gaussians, 1.0)], None)
    job = TrainJob(parts=("background",), sky="none", train=settings, random_seed=0)
    return TrainedCheckpoint.of(model, job, PROVENANCE)


@pytest.fixture(scope="module")
def package(tmp_path_factory, checkpoint, tiny_scene):
    path = tmp_path_factory.mktemp("usd") / "scene.usdz"
    job = ExportJob(eval_camera="CAM_FRONT", gaussians=KEPT)
    export_usd(path, checkpoint, tiny_scene, job, PROVENANCE)
    return path


@pytest.fixture(scope="module")
def stage(package):
    return Usd.Stage.Open(str(package))


def splat_at(stage: Usd.Stage, path: str = "/World/background") -> UsdVol.ParticleField3DGaussianSplat:
    prim = stage.GetPrimAtPath(path)
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    return UsdVol.ParticleField3DGaussianSplat(prim)


def pixels_by_usd(camera: Gf.Camera, size: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Where the camera's frustum shows world points: (n, 2) continuous pixels."""
    seen = camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix()
    device = np.array([seen.Transform(Gf.Vec3d(*point)) for point in points.tolist()])
    return (device[:, :2] * [1, -1] + 1) / 2 * size


def test_the_stage_is_in_metres_with_z_up_and_provenance(stage, tiny_scene):
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/World"
    note = stage.GetRootLayer().customLayerData["drivesplat"]
    assert list(note.pop("origin")) == tiny_scene.origin.tolist()
    digests = {name: PROVENANCE[name] for name in ("settings_sha256", "code_sha256", "inputs_sha256")}
    assert note == {"scene": "0001", "dataset": "tiny", **digests}


def test_the_stage_has_the_gaussians_of_largest_coverage_in_linear_values(stage):
    splats = random_splats()
    areas = splats.scales.sort(dim=1).values[:, 1:].prod(dim=1)
    assert float(areas.max()) < 10 * float(areas.median())
    chosen = (splats.opacities * areas).argsort(descending=True)[:KEPT].sort().values
    expected = splats[chosen]
    splat = splat_at(stage)
    np.testing.assert_array_equal(splat.GetPositionsAttr().Get(), expected.means)
    np.testing.assert_allclose(splat.GetScalesAttr().Get(), expected.scales, rtol=1e-5)
    np.testing.assert_allclose(splat.GetOpacitiesAttr().Get(), expected.opacities, rtol=1e-5)
    assert splat.GetProjectionModeHintAttr().Get() == "perspective"
    assert splat.GetSortingModeHintAttr().Get() == "zDepth"


def test_the_camera_has_the_recorded_poses_and_times(stage, tiny_scene):
    """Time codes are thirtieths of seconds since the first image; a world point falls on the pixel that K gives."""
    camera = UsdGeom.Camera(stage.GetPrimAtPath("/World/camera"))
    assert stage.GetTimeCodesPerSecond() == 30.0
    first = min(frame.timestamp for frame in tiny_scene.frames)
    codes = [(frame.timestamp - first) * 1e-6 * 30.0 for frame in tiny_scene.frames]
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == pytest.approx((codes[0], codes[-1]))
    transform = camera.GetOrderedXformOps()
    assert [op.GetOpType() for op in transform] == [UsdGeom.XformOp.TypeTransform]
    samples = np.array(transform[0].GetTimeSamples())
    assert all(np.abs(samples - code).min() < 1e-6 for code in codes)
    assert np.diff(samples).min() > 0.0 and np.diff(samples).max() < 1.001, "thirty times a second at least"
    for i, frame in enumerate(tiny_scene.frames):
        at_code = camera.GetCamera(codes[i])
        points = frame.ego_to_world[:3, 3] + np.array([[12.0, 3.0, 0.5], [20.0, -4.0, 2.0], [9.0, 0.0, 0.0]])
        in_camera = np.column_stack([points, np.ones(3)]) @ np.linalg.inv(frame.camera_to_world).T
        projected = in_camera[:, :3] @ frame.intrinsics.T
        expected = projected[:, :2] / projected[:, 2:] + 0.5  # OpenCV counts from the first pixel's centre
        np.testing.assert_allclose(pixels_by_usd(at_code, (96, 54), points), expected, atol=2e-4)
        np.testing.assert_allclose(at_code.frustum.GetPosition(), frame.camera_to_world[:3, 3], atol=1e-9)


OPENCV_TO_USD = np.diag([1.0, -1.0, -1.0, 1.0])


def on_a_circle(seconds: float) -> np.ndarray:
    """A camera (4, 4) that drives at 10 m/s around a circle of 10 m, a radian a second, looking ahead, tilted."""
    turned = Rotation.from_euler("z", seconds) * Rotation.from_euler("xyz", [-1.5, 0.1, -1.6])
    return rigid(turned.as_matrix(), np.array([10.0 * np.sin(seconds), 10.0 - 10.0 * np.cos(seconds), 1.5]))


@pytest.fixture(scope="module")
def turning(tiny_scene):
    """The tiny drive on that circle, four images a second; its first image at 0 s."""
    first = min(frame.timestamp for frame in tiny_scene.frames)
    frames = tuple(
        dataclasses.replace(frame, camera_to_world=on_a_circle((frame.timestamp - first) * 1e-6))
        for frame in tiny_scene.frames
    )
    return dataclasses.replace(tiny_scene, frames=frames)


def pose_by_usd(stage: Usd.Stage, code: float) -> np.ndarray:
    """The camera's OpenCV pose (4, 4) as a program that plays the stage finds it."""
    prim = UsdGeom.Xformable(stage.GetPrimAtPath("/World/camera"))
    return np.array(prim.ComputeLocalToWorldTransform(Usd.TimeCode(code))).T @ OPENCV_TO_USD


def test_between_recorded_times_the_camera_stays_rigid_and_on_its_path(turning):
    """OpenUSD interpolates a matrix entry by entry: between poses that are far apart it shrinks and shears."""
    stage = splat_stage({}, recorded_cameras(turning, "CAM_FRONT"), {})
    last = max(turning.seconds(frame.timestamp) for frame in turning.frames)
    for seconds in np.random.default_rng(0).uniform(0.0, last, 400):
        pose = pose_by_usd(stage, seconds * 30.0)
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-3)
        expected = on_a_circle(seconds)
        np.testing.assert_allclose(pose[:3, :3], expected[:3, :3], atol=5e-3)
        np.testing.assert_allclose(pose[:3, 3], expected[:3, 3], atol=0.02)


def test_the_camera_is_the_requested_one(turning):
    """Images of another camera, elsewhere and between, are none of its path's."""
    other = tuple(
        dataclasses.replace(
            frame, camera="CAM_BACK", timestamp=frame.timestamp + 40_000, camera_to_world=on_a_circle(90.0)
        )
        for frame in turning.frames
    )
    both = dataclasses.replace(turning, frames=(*turning.frames, *other))
    alone, among = (recorded_cameras(scene, "CAM_FRONT") for scene in (turning, both))
    assert [time for time, _ in alone] == [time for time, _ in among]
    assert all(a.transform == b.transform for (_, a), (_, b) in zip(alone, among, strict=True))


def test_non_square_pixels_and_principal_point_are_those_of_K():
    K, size, camera_to_world = oblique_camera()
    in_camera = np.random.default_rng(0).uniform([-2, -1, 3], [2, 1, 9], (20, 3))
    points = in_camera @ camera_to_world[:3, :3].T + camera_to_world[:3, 3]
    projected = in_camera @ K.T
    found = pixels_by_usd(usd_camera(K, size, camera_to_world), size, points)
    np.testing.assert_allclose(found, projected[:, :2] / projected[:, 2:], atol=1e-3)


def test_the_package_is_one_binary_layer_without_paths_of_the_machine(package, stage):
    with zipfile.ZipFile(package) as archive:
        assert archive.namelist() == ["scene.usdc"]
        assert archive.read("scene.usdc").startswith(b"PXR-USDC")
    assert str(package.parent).encode() not in package.read_bytes()
    _, assets, unresolved = UsdUtils.ComputeAllDependencies(str(package))
    assert not assets and not unresolved
    assert [path.name for path in package.parent.iterdir()] == ["scene.usdz"]


def test_openusds_own_validators_find_nothing(stage):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in errors] == []


def test_an_unwritable_package_is_named_and_leaves_no_file(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ResultError, match=r"file/scene\.usdz: cannot be written"):
        write_usdz(tmp_path / "file/scene.usdz", splat_stage({}, [(0.0, Gf.Camera())], {}))
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.fixture
def little_room():
    """No file may grow beyond 100 kB, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_a_full_disk_is_reported_and_the_previous_package_stays(tmp_path, little_room):
    (tmp_path / "scene.usdz").write_text("the one before")
    many = {"background": SampledGroup(random_splats(3000))}
    with pytest.raises(ResultError, match=r"scene\.usdz: cannot be written .*File too large.*; free space"):
        write_usdz(tmp_path / "scene.usdz", splat_stage(many, [(0.0, Gf.Camera())], {}))
    assert [path.name for path in tmp_path.iterdir()] == ["scene.usdz"]
    assert (tmp_path / "scene.usdz").read_text() == "the one before"
