"""scene.usdz plays: objects are, at any time code, where and whether the model has them, as OpenUSD reads it again."""

import numpy as np
import pytest
from helpers.hand_made import round_gaussians
from helpers.hand_made_traffic import (
    GONE_AT_TIMES,
    TRAJECTORIES,
    TURNING,
    Traffic,
    own_gaussians,
    some_gaussians,
    with_turning_track,
)
from helpers.records import EMPTY_CHECKPOINT
from pxr import Gf, Kind, Usd, UsdGeom, UsdUtils, UsdValidation, UsdVol
from scipy.spatial.transform import Rotation

from drivesplat.export import usd
from drivesplat.export.sampled_motion import sample_motion
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.usd import export_usd, splat_stage, write_usdz
from drivesplat.model.splat_model import SplatModel
from drivesplat.settings.export import ExportJob

PROVENANCE = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64, "stages": {}}
MIDDLE = 2.25
PATHS = {TURNING: f"/World/actors/_{TURNING}", GONE_AT_TIMES: f"/World/actors/{GONE_AT_TIMES}"}
"""An identifier does not begin with a digit."""


def street() -> SplatModel:
    return SplatModel([round_gaussians([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], sizes=0.5), Traffic()], None)


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return with_turning_track(tiny_scene)


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


def splat_of(stage: Usd.Stage, track_id: str) -> UsdVol.ParticleField3DGaussianSplat:
    prim = stage.GetPrimAtPath(PATHS[track_id])
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    return UsdVol.ParticleField3DGaussianSplat(prim)


def matrix(stage: Usd.Stage, path: str, code: Usd.TimeCode) -> np.ndarray:
    """Local to world (4, 4) for column vectors, as a program that plays the stage finds it."""
    return np.array(UsdGeom.Xformable(stage.GetPrimAtPath(path)).ComputeLocalToWorldTransform(code)).T


def seen(stage: Usd.Stage, path: str, code: Usd.TimeCode) -> bool:
    return UsdGeom.Imageable(stage.GetPrimAtPath(path)).ComputeVisibility(code) != UsdGeom.Tokens.invisible


def present_seconds(track_id: str, count: int = 300) -> np.ndarray:
    """Times all over those at which an object is there."""
    trajectory, times = TRAJECTORIES[track_id], np.random.default_rng(0).uniform(-0.3, 5.0, count)
    return times[[trajectory.is_there(seconds) for seconds in times]]


@pytest.mark.parametrize("track_id", TRAJECTORIES)
def test_gaussians_of_an_object_are_where_the_model_has_them_at_any_time_code(stage, track_id):
    """To less than a millimetre, between samples too; in float64 and closed form."""
    own = own_gaussians(track_id, MIDDLE).means.double().numpy()
    splat = splat_of(stage, track_id)
    np.testing.assert_array_equal(splat.GetPositionsAttr().Get(), own)
    seconds = present_seconds(track_id)
    assert len(seconds) > 100
    for now in seconds:
        local_to_world, pose = matrix(stage, PATHS[track_id], now * 30.0), TRAJECTORIES[track_id].pose(now)
        found = own @ local_to_world[:3, :3].T + local_to_world[:3, 3]
        expected = own @ pose[:3, :3].T + pose[:3, 3]
        assert np.linalg.norm(found - expected, axis=1).max() < 1e-3
        np.testing.assert_array_equal(local_to_world[3], [0.0, 0.0, 0.0, 1.0])


def test_a_point_that_openusd_transforms_itself_is_where_the_model_has_it(stage):
    """The rows and columns of the matrix are the right way round."""
    code, trajectory = Usd.TimeCode(30.0), TRAJECTORIES[TURNING]
    transform = UsdGeom.Xformable(stage.GetPrimAtPath(PATHS[TURNING])).ComputeLocalToWorldTransform(code)
    expected = trajectory.pose(1.0) @ [1.0, -2.0, 0.5, 1.0]
    np.testing.assert_allclose(transform.Transform(Gf.Vec3d(1.0, -2.0, 0.5)), expected[:3], rtol=0, atol=1e-9)


@pytest.mark.parametrize("track_id", TRAJECTORIES)
def test_at_images_and_whole_time_codes_the_pose_is_exact(stage, scene, track_id):
    trajectory = TRAJECTORIES[track_id]
    images = [scene.seconds(frame.timestamp) for frame in scene.frames]
    for seconds in [*images, *(np.arange(140) / 30.0)]:
        if trajectory.is_there(seconds):
            # a sample is at a whole microsecond
            found = matrix(stage, PATHS[track_id], Usd.TimeCode(seconds * 30.0))
            np.testing.assert_allclose(found, trajectory.pose(seconds), rtol=0, atol=1e-5)


@pytest.mark.parametrize("track_id", TRAJECTORIES)
def test_an_object_is_visible_exactly_while_it_is_present(stage, track_id):
    trajectory = TRAJECTORIES[track_id]
    for now in np.random.default_rng(1).uniform(-2.0, 7.0, 500):
        assert seen(stage, PATHS[track_id], now * 30.0) == trajectory.is_there(now), now
    for first, last in ((trajectory.times[a] - 0.25, trajectory.times[b] + 0.25) for a, b in trajectory.runs):
        for edge, inwards in ((first, 1e-4), (last, -1e-4)):
            assert seen(stage, PATHS[track_id], (edge + inwards) * 30.0)
            assert not seen(stage, PATHS[track_id], (edge - inwards) * 30.0)


def test_the_background_is_static_and_always_visible(stage):
    for code in (Usd.TimeCode.Default(), Usd.TimeCode(-100.0), Usd.TimeCode(60.0), Usd.TimeCode(1e6)):
        np.testing.assert_array_equal(matrix(stage, "/World/background", code), np.eye(4))
        assert seen(stage, "/World/background", code)


@pytest.mark.parametrize("track_id", TRAJECTORIES)
def test_orientations_and_colours_are_those_of_the_objects_frame(stage, track_id):
    own, splat = own_gaussians(track_id, MIDDLE), splat_of(stage, track_id)
    found = Rotation.from_quat([[*q.GetImaginary(), q.GetReal()] for q in splat.GetOrientationsAttr().Get()])
    expected = Rotation.from_quat(own.quats.numpy(), scalar_first=True)
    np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-5)
    coefficients = np.array(splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    np.testing.assert_allclose(coefficients, own.sh.reshape(-1, 3), atol=1e-6)
    assert splat.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    np.testing.assert_allclose(splat.GetOpacitiesAttr().Get(), own.opacities, atol=1e-6)


def test_programs_that_select_by_model_find_background_and_objects(stage):
    components = {str(prim.GetPath()) for prim in stage.Traverse() if Usd.ModelAPI(prim).IsKind(Kind.Tokens.component)}
    assert components == {"/World/background", *PATHS.values()}
    assert all(stage.GetPrimAtPath(path).IsModel() for path in components), "a hierarchy of models without gaps"


def test_openusds_own_validators_find_nothing(stage, package):
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetErrorAsString() for error in errors] == []
    _, assets, unresolved = UsdUtils.ComputeAllDependencies(str(package))
    assert not assets and not unresolved


def still(count: int) -> SampledGroup:
    return SampledGroup(some_gaussians(count, 0, count))


def moving(count: int) -> SampledGroup:
    motion = sample_motion(TRAJECTORIES[TURNING].motion, np.array([]), 1.0)
    return SampledGroup(some_gaussians(count, 0, count), motion)


def counts(stage: Usd.Stage) -> dict[str, int]:
    prims = (prim for prim in stage.Traverse() if prim.IsA(UsdVol.ParticleField))
    return {
        str(prim.GetPath()): len(UsdVol.ParticleField3DGaussianSplat(prim).GetPositionsAttr().Get()) for prim in prims
    }


def test_every_group_is_a_prim(tmp_path):
    groups = {"background": still(4), "kerb 7/x": still(2), "empty": still(0), "car": moving(3)}
    write_usdz(tmp_path / "a.usdz", splat_stage(groups, [(0.0, Gf.Camera())], {}))
    found = counts(Usd.Stage.Open(str(tmp_path / "a.usdz")))
    assert found == {"/World/background": 4, "/World/kerb_7_x": 2, "/World/empty": 0, "/World/actors/car": 3}


def test_an_object_may_have_the_name_of_the_camera():
    found = counts(splat_stage({"camera": moving(1), "background": moving(2)}, [(0.0, Gf.Camera())], {}))
    assert found == {"/World/actors/camera": 1, "/World/actors/background": 2}


def test_the_budget_is_shared_by_all_groups_and_an_empty_object_is_valid(tmp_path, scene, monkeypatch):
    """The two wide, opaque Gaussians of the background cover most."""
    monkeypatch.setattr(usd, "trained_model", lambda _: street())
    monkeypatch.setattr("helpers.hand_made_traffic.own_gaussians", lambda *_: some_gaussians(12, 1, 0)[slice(0, 1)])
    job = ExportJob(eval_camera="CAM_FRONT", gaussians=2)
    export_usd(tmp_path / "scene.usdz", EMPTY_CHECKPOINT, scene, job, PROVENANCE)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdz"))
    assert sum(counts(stage).values()) == 2 and counts(stage).keys() == {"/World/background", *PATHS.values()}
    assert 0 in counts(stage).values()
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert not UsdValidation.ValidationContext(validators).Validate(stage)
