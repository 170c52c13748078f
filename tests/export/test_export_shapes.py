"""Objects that deform, in exports: the shapes that the model has, at the times that were asked for."""

import numpy as np
import pytest
import torch
from helpers.hand_made import round_gaussians
from helpers.hand_made_traffic import TURNING, with_turning_track
from helpers.samples import sampled
from helpers.walkers import walker
from pxr import Gf, Usd, UsdVol

from drivesplat.export.thinning import thinned_groups
from drivesplat.export.trained_parts import shown_timestamp, trained_gaussians, trained_groups
from drivesplat.export.usd import splat_stage, write_usdz
from drivesplat.model.deformable import Deformable
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import TimeState
from drivesplat.settings.train import GaussianSettings

NO_TIMES = np.array([], dtype=np.int64)


@pytest.fixture(scope="module")
def people() -> Deformable:
    return walker()


@pytest.fixture(scope="module")
def model(people) -> SplatModel:
    return SplatModel([round_gaussians([[1.0, 2.0, 3.0]], sizes=0.5), people], None)


@pytest.fixture(scope="module")
def scene(tiny_scene):
    return with_turning_track(tiny_scene)


def in_box(people: Deformable, second: float) -> np.ndarray:
    return people.local(TimeState(*people.state(second).now)).means.detach().numpy()


def test_shapes_are_those_of_the_model_and_others_at_other_times(model, people, scene):
    shapes = trained_groups(model, scene, NO_TIMES)[TURNING].shapes
    assert shapes is not None and shapes.means.shape == (len(shapes.seconds), 30, 3)
    for second, means in zip(shapes.seconds, shapes.means, strict=True):
        np.testing.assert_allclose(means, in_box(people, float(second)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(shapes.quats, axis=-1), 1.0, atol=1e-6)
    assert np.abs(shapes.means - shapes.means[0]).max() > 0.05


def test_what_is_rigid_has_no_shapes(model, scene):
    assert trained_groups(model, scene, NO_TIMES)["background"].shapes is None
    assert all(part.shapes("nobody", [0.0]) is None for part in model.parts)


def test_thinning_leaves_each_gaussian_its_own_shapes(model, scene):
    groups = trained_groups(model, scene, NO_TIMES)
    kept = thinned_groups(groups, 12)[TURNING]
    whole = groups[TURNING]
    rows = [int((whole.gaussians.means == mean).all(dim=1).nonzero()) for mean in kept.gaussians.means]
    assert 0 < len(rows) < 30
    np.testing.assert_array_equal(kept.shapes.means, whole.shapes.means[:, rows])
    np.testing.assert_array_equal(kept.shapes.quats, whole.shapes.quats[:, rows])


def test_a_gaussian_that_is_not_finite_is_dropped_with_its_shapes(people, scene):
    broken = Deformable({name: value.detach().clone() for name, value in people.params.items()},
                        people.timeline.tracks, people._settings, GaussianSettings())  # fmt: skip
    with torch.no_grad():
        broken.params["opacities"][4] = torch.nan
    group = trained_groups(SplatModel([broken], None), scene, NO_TIMES)[TURNING]
    assert len(group.gaussians) == 29 and group.shapes.means.shape[1] == 29


def test_usd_plays_positions_orientations_and_extents(model, people, scene, tmp_path):
    groups = trained_groups(model, scene, NO_TIMES)
    write_usdz(tmp_path / "a.usdz", splat_stage(groups, [(0.0, Gf.Camera())], {}))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(f"/World/actors/_{TURNING}"))
    shapes = groups[TURNING].shapes
    for i in range(0, len(shapes.seconds), 7):
        code = Usd.TimeCode(float(shapes.seconds[i]) * 30.0)
        positions = np.array(splat.GetPositionsAttr().Get(code))
        np.testing.assert_allclose(positions, in_box(people, float(shapes.seconds[i])), atol=1e-5)
        real = np.array([quat.GetReal() for quat in splat.GetOrientationsAttr().Get(code)])
        np.testing.assert_allclose(real, shapes.quats[i, :, 0], atol=1e-5)
        low, high = np.array(splat.GetExtentAttr().Get(code))
        assert (low < positions).all() and (positions < high).all()
    shown = scene.seconds(shown_timestamp(scene, None))
    np.testing.assert_allclose(np.array(splat.GetPositionsAttr().Get()), in_box(people, shown), atol=1e-5)
    still = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/background"))
    assert still.GetPositionsAttr().GetNumTimeSamples() == 0


def test_a_ply_shows_the_time_that_was_asked_for(model, people, scene):
    for second in (0.25, 1.0):
        own = trained_groups(model, scene, NO_TIMES, second)[TURNING].gaussians
        np.testing.assert_allclose(own.means.numpy(), in_box(people, second), atol=1e-6)
        together = trained_gaussians(model, scene, second)
        expected = sampled(people, second).means.detach()
        np.testing.assert_allclose(together.means[-30:].detach().numpy(), expected.numpy(), atol=1e-5)
