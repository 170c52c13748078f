"""scene.usdz as OpenUSD reads it again: Gaussians, the camera that recorded them, and objects at any time code."""

import dataclasses
import resource
import zipfile

import numpy as np
import pytest
from helpers.hand_made import round_gaussians
from helpers.hand_made_traffic import TRAJECTORIES, TURNING, Traffic, own_gaussians, some_gaussians
from helpers.records import EMPTY_CHECKPOINT
from pxr import Gf, Kind, Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol
from scipy.spatial.transform import Rotation

from drivesplat.errors import ResultError
from drivesplat.export import usd
from drivesplat.export.sampled_motion import sample_motion
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.usd import export_usd, recorded_cameras, splat_stage, usd_camera, write_usdz
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import rigid
from drivesplat.settings.export import ExportJob

PROVENANCE = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64, "stages": {}}
MIDDLE = 2.25
PATHS = {name: f"/World/actors/{'_' if name[0].isdigit() else ''}{name}" for name in TRAJECTORIES}
"""An identifier does not begin with a digit."""
OPENCV_TO_USD = np.diag([1.0, -1.0, -1.0, 1.0])


def street() -> SplatModel:
    return SplatModel([round_gaussians([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], sizes=0.5), Traffic()], None)


@pytest.fixture(scope="module")
def package(tmp_path_factory, scene):
    path = tmp_path_factory.mktemp("usd") / "scene.usdz"
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(usd, "trained_model", lambda _: street())
        export_usd(path, EMPTY_CHECKPOINT, scene, ExportJob(eval_camera="CAM_FRONT", gaussians=1000), PROVENANCE)
    return path


@pytest.fixture(scope="module")
def stage(package):
    return Usd.Stage.Open(str(package))


def pixels_by_usd(camera: Gf.Camera, size: tuple[int, int], points: np.ndarray) -> np.ndarray:
    """Where the camera's frustum shows world points: (n, 2) continuous pixels."""
    seen = camera.frustum.ComputeViewMatrix() * camera.frustum.ComputeProjectionMatrix()
    device = np.array([seen.Transform(Gf.Vec3d(*point)) for point in points.tolist()])
    return (device[:, :2] * [1, -1] + 1) / 2 * size


def test_the_package_is_one_binary_layer_in_metres_with_z_up_and_provenance(package, stage, tiny_scene):
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/World"
    note = stage.GetRootLayer().customLayerData["drivesplat"]
    assert list(note.pop("origin")) == tiny_scene.origin.tolist()
    digests = {name: PROVENANCE[name] for name in ("settings_sha256", "code_sha256", "inputs_sha256")}
    assert note == {"scene": "0001", "dataset": "tiny", **digests}
    with zipfile.ZipFile(package) as archive:
        assert archive.namelist() == ["scene.usdc"]
        assert archive.read("scene.usdc").startswith(b"PXR-USDC")
    assert str(package.parent).encode() not in package.read_bytes(), "no path of the machine"
    _, assets, unresolved = UsdUtils.ComputeAllDependencies(str(package))
    assert not assets and not unresolved
    assert [path.name for path in package.parent.iterdir()] == ["scene.usdz"]


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


def test_between_recorded_times_the_camera_stays_rigid_and_on_its_path(turning):
    """OpenUSD interpolates a matrix entry by entry: between poses that are far apart it shrinks and shears."""
    stage = splat_stage({}, recorded_cameras(turning, "CAM_FRONT"), {})
    last = max(turning.seconds(frame.timestamp) for frame in turning.frames)
    for seconds in np.random.default_rng(0).uniform(0.0, last, 120):
        pose = matrix(stage, "/World/camera", Usd.TimeCode(seconds * 30.0)) @ OPENCV_TO_USD
        np.testing.assert_allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-3)
        expected = on_a_circle(seconds)
        np.testing.assert_allclose(pose[:3, :3], expected[:3, :3], atol=5e-3)
        np.testing.assert_allclose(pose[:3, 3], expected[:3, 3], atol=0.02)


def test_the_camera_is_the_requested_one(turning):
    """Images of another camera, elsewhere and between, are none of its path's."""
    elsewhere = {"camera": "CAM_BACK", "camera_to_world": on_a_circle(90.0)}
    other = (dataclasses.replace(f, **elsewhere, timestamp=f.timestamp + 40_000) for f in turning.frames)
    both = dataclasses.replace(turning, frames=(*turning.frames, *other))
    alone, among = (recorded_cameras(scene, "CAM_FRONT") for scene in (turning, both))
    assert [time for time, _ in alone] == [time for time, _ in among]
    assert all(a.transform == b.transform for (_, a), (_, b) in zip(alone, among, strict=True))


def test_non_square_pixels_and_principal_point_are_those_of_K():
    K, size = np.array([[310.0, 0.0, 175.5], [0.0, 290.0, 81.25], [0.0, 0.0, 1.0]]), (320, 180)
    turned = Rotation.from_euler("xyz", [-1.4, 0.1, 0.7]).as_matrix()
    camera_to_world = rigid(turned, np.array([5.0, -3.0, 1.6]))
    in_camera = np.random.default_rng(0).uniform([-2, -1, 3], [2, 1, 9], (20, 3))
    points = in_camera @ camera_to_world[:3, :3].T + camera_to_world[:3, 3]
    projected = in_camera @ K.T
    found = pixels_by_usd(usd_camera(K, size, camera_to_world), size, points)
    np.testing.assert_allclose(found, projected[:, :2] / projected[:, 2:], atol=1e-3)


def test_a_failed_write_is_named_leaves_no_half_file_and_the_previous_package(tmp_path):
    """A limit of 100 kB on the size of files stands for a full disk."""
    (tmp_path / "scene.usdz").write_text("the one before")
    with pytest.raises(ResultError, match=r"scene\.usdz/scene\.usdz: cannot be written"):
        write_usdz(tmp_path / "scene.usdz/scene.usdz", splat_stage({}, [(0.0, Gf.Camera())], {}))
    many = splat_stage({"background": SampledGroup(some_gaussians(3000, 2, 0))}, [(0.0, Gf.Camera())], {})
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(ResultError, match=r"scene\.usdz: cannot be written .*File too large.*; free space"):
            write_usdz(tmp_path / "scene.usdz", many)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [path.name for path in tmp_path.iterdir()] == ["scene.usdz"]
    assert (tmp_path / "scene.usdz").read_text() == "the one before"


def splat_of(stage: Usd.Stage, track_id: str) -> UsdVol.ParticleField3DGaussianSplat:
    prim = stage.GetPrimAtPath(PATHS[track_id])
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    return UsdVol.ParticleField3DGaussianSplat(prim)


def matrix(stage: Usd.Stage, path: str, code: Usd.TimeCode) -> np.ndarray:
    """Local to world (4, 4) for column vectors, as a program that plays the stage finds it: where it puts a point."""
    found = UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(code)
    np.testing.assert_allclose(found.Transform(Gf.Vec3d(1, -2, 0.5)), (np.array(found).T @ [1, -2, 0.5, 1])[:3])
    return np.array(found).T


def seen(stage: Usd.Stage, path: str, code: Usd.TimeCode) -> bool:
    return UsdGeom.Imageable(stage.GetPrimAtPath(path)).ComputeVisibility(code) != UsdGeom.Tokens.invisible


def complaints(stage: Usd.Stage) -> list[str]:
    """Of OpenUSD's own validators."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    return [error.GetErrorAsString() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


@pytest.mark.parametrize("track_id", TRAJECTORIES)
def test_an_object_is_where_and_whether_the_model_has_it_at_any_time_code(stage, scene, track_id):
    """To less than a millimetre, between samples too, and exactly at images and whole time codes (a sample is at a
    whole microsecond); in float64 and closed form."""
    trajectory, path, random = TRAJECTORIES[track_id], PATHS[track_id], np.random.default_rng(0)
    own = own_gaussians(track_id, MIDDLE).means.double().numpy()
    seconds = [now for now in random.uniform(-0.3, 5.0, 100) if trajectory.is_there(now)]
    assert len(seconds) > 40
    for now in seconds:
        local_to_world, pose = matrix(stage, path, now * 30.0), trajectory.pose(now)
        found = own @ local_to_world[:3, :3].T + local_to_world[:3, 3]
        expected = own @ pose[:3, :3].T + pose[:3, 3]
        assert np.linalg.norm(found - expected, axis=1).max() < 1e-3
        np.testing.assert_array_equal(local_to_world[3], [0.0, 0.0, 0.0, 1.0])
    exact = [*(scene.seconds(frame.timestamp) for frame in scene.frames), *(np.arange(140) / 30.0)]
    for now in filter(trajectory.is_there, exact):
        np.testing.assert_allclose(matrix(stage, path, now * 30.0), trajectory.pose(now), rtol=0, atol=1e-5)
    for now in random.uniform(-2.0, 7.0, 150):
        assert seen(stage, path, now * 30.0) == trajectory.is_there(now), now
    for first, last in ((trajectory.times[a] - 0.25, trajectory.times[b] + 0.25) for a, b in trajectory.runs):
        for edge, inwards in ((first, 1e-4), (last, -1e-4)):
            assert seen(stage, path, (edge + inwards) * 30.0) and not seen(stage, path, (edge - inwards) * 30.0)


@pytest.mark.parametrize("track_id", TRAJECTORIES)
def test_gaussians_are_those_of_the_objects_frame_in_linear_values(stage, track_id):
    own, splat = own_gaussians(track_id, MIDDLE), splat_of(stage, track_id)
    np.testing.assert_array_equal(splat.GetPositionsAttr().Get(), own.means)
    np.testing.assert_allclose(splat.GetScalesAttr().Get(), own.scales, rtol=1e-5)
    np.testing.assert_allclose(splat.GetOpacitiesAttr().Get(), own.opacities, rtol=1e-5)
    found = Rotation.from_quat([[*q.GetImaginary(), q.GetReal()] for q in splat.GetOrientationsAttr().Get()])
    expected = Rotation.from_quat(own.quats.numpy(), scalar_first=True)
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-5)
    coefficients = np.array(splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_allclose(coefficients, own.sh.reshape(-1, 3), atol=1e-6)
    assert splat.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    assert splat.GetProjectionModeHintAttr().Get() == "perspective"
    assert splat.GetSortingModeHintAttr().Get() == "zDepth"


def test_programs_find_background_and_objects_and_openusds_own_validators_nothing(stage):
    components = {str(prim.GetPath()) for prim in stage.Traverse() if Usd.ModelAPI(prim).IsKind(Kind.Tokens.component)}
    assert components == {"/World/background", *PATHS.values()}
    assert all(stage.GetPrimAtPath(path).IsModel() for path in components), "a hierarchy of models without gaps"
    assert complaints(stage) == []
    for code in (Usd.TimeCode.Default(), Usd.TimeCode(-100.0), Usd.TimeCode(60.0), Usd.TimeCode(1e6)):
        np.testing.assert_array_equal(matrix(stage, "/World/background", code), np.eye(4))
        assert seen(stage, "/World/background", code)


def counts(stage: Usd.Stage) -> dict[str, int]:
    splats = (UsdVol.ParticleField3DGaussianSplat(prim) for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField))
    return {str(splat.GetPath()): len(splat.GetPositionsAttr().Get()) for splat in splats}


def test_every_group_is_a_prim_and_an_object_may_have_the_name_of_the_camera(tmp_path):
    def still(count: int) -> SampledGroup:
        return SampledGroup(some_gaussians(count, 0, count))

    def moving(count: int) -> SampledGroup:
        motion = sample_motion(TRAJECTORIES[TURNING].motion, np.array([]), 1.0)
        return SampledGroup(some_gaussians(count, 0, count), motion)

    groups = {"background": still(4), "kerb 7/x": still(2), "empty": still(0), "car": moving(3)}
    write_usdz(tmp_path / "a.usdz", splat_stage(groups, [(0.0, Gf.Camera())], {}))
    found = counts(Usd.Stage.Open(str(tmp_path / "a.usdz")))
    assert found == {"/World/background": 4, "/World/kerb_7_x": 2, "/World/empty": 0, "/World/actors/car": 3}
    found = counts(splat_stage({"camera": moving(1), "background": moving(2)}, [(0.0, Gf.Camera())], {}))
    assert found == {"/World/actors/camera": 1, "/World/actors/background": 2}


def test_the_budget_is_shared_by_all_groups_and_an_empty_object_is_valid(tmp_path, scene, monkeypatch):
    """The two wide, opaque Gaussians of the background cover most."""
    monkeypatch.setattr(usd, "trained_model", lambda _: street())
    monkeypatch.setattr("helpers.hand_made_traffic.own_gaussians", lambda *_: some_gaussians(12, 1, 0)[slice(0, 1)])
    job = ExportJob(eval_camera="CAM_FRONT", gaussians=2)
    export_usd(tmp_path / "scene.usdz", EMPTY_CHECKPOINT, scene, job, PROVENANCE)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    assert counts(stage) == {"/World/background": 2, **dict.fromkeys(PATHS.values(), 0)}
    assert complaints(stage) == []
