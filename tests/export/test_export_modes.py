"""Objects that deform, in exports: their shapes at the times that were asked for, and their modes in the viewer."""

import numpy as np
import pytest
import torch
from helpers.chromium import in_a_browser
from helpers.hand_made import round_gaussians
from helpers.hand_made_traffic import TURNING
from helpers.samples import sampled, sampled_with
from helpers.viewer_pages import (
    a_model,
    a_sky,
    choose,
    click,
    oblique_frame,
    path_from,
    psnr,
    rendered,
    set_second,
    settled,
    splats,
)
from helpers.walkers import SIZE, walker, walking
from pxr import Gf, Usd, UsdVol
from scipy.spatial.transform import Rotation

from drivesplat.export.modes import Gait, Modes, fitted_modes
from drivesplat.export.sampled_motion import SampledMotion
from drivesplat.export.thinning import thinned_groups
from drivesplat.export.trained_parts import (
    SampledGroup,
    sampled_shapes,
    shown_timestamp,
    trained_gaussians,
    trained_groups,
)
from drivesplat.export.usd import splat_stage, write_usdz
from drivesplat.export.viewer import viewer_page
from drivesplat.export.viewer_scene import ViewerContent, modes_array
from drivesplat.kernels.placement import LocalGaussians
from drivesplat.model.deformable import Deformable
from drivesplat.model.gaussians import concatenate
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement
from drivesplat.settings.train import GaussianSettings
from drivesplat.trajectories.sampled_edit import Instance, InstanceMotion, SampledEdit

NO_TIMES = np.array([], dtype=np.int64)
EDITED = {"walked": 0.7, "scale": 1.25, "phase": 0.3}


@pytest.fixture(scope="module")
def people() -> Deformable:
    return walker(strength=0.05)


@pytest.fixture(scope="module")
def model(people) -> SplatModel:
    return SplatModel([round_gaussians([[1.0, 2.0, 3.0]], sizes=0.5), people], None)


@pytest.fixture(scope="module")
def group(model, scene) -> SampledGroup:
    return trained_groups(model, scene, NO_TIMES, 1.0)[TURNING]


@pytest.fixture(scope="module")
def modes(model, group) -> Modes:
    return fitted_modes(model, {TURNING: group})[TURNING]


def in_box(people: Deformable, second: float, **placement: float) -> LocalGaussians:
    """The Gaussians that the model places in the box, as recorded or with changes of their gait."""
    return people.local(people.walked_state(second, ActorPlacement(TURNING, **placement)))


def turned_by(quats: torch.Tensor, turns: np.ndarray, others: torch.Tensor) -> np.ndarray:
    """The angles (radians) between `quats`, turned by vectors as modes give them, and `others`."""
    turn = Rotation.from_quat(np.hstack([np.ones((len(turns), 1)), turns]), scalar_first=True)
    found = turn * Rotation.from_quat(quats.detach().numpy(), scalar_first=True)
    return (found.inv() * Rotation.from_quat(others.detach().numpy(), scalar_first=True)).magnitude()


@pytest.mark.parametrize(("second", "changes"), [(0.3, {}), (1.0, {}), (1.0, EDITED), (2.7, EDITED)])
def test_modes_give_the_shapes_of_the_model(people, group, modes, second, changes):
    """Also those of gaits that were not recorded; orientations to a degree or two, since turns are not quite linear."""
    gait = Gait(np.array([second]), np.array([0.7]), 1.25, 0.3) if changes else Gait(np.array([second]))
    (weights,) = modes.weights(gait)
    expected = in_box(people, second, **changes)
    means = group.gaussians.means.detach().numpy() + np.einsum("m,mnj->nj", weights, modes.shifts)
    far = np.abs(expected.means.detach().numpy() - group.gaussians.means.detach().numpy()).max()
    np.testing.assert_allclose(means, expected.means.detach().numpy(), atol=2e-3)
    angles = turned_by(group.gaussians.quats, np.einsum("m,mnj->nj", weights, modes.turns), expected.quats)
    assert np.degrees(angles).mean() < 2.0 and np.degrees(angles).max() < 8.0
    assert far > 0.05 or second == 1.0, "the group shows the shape of second 1"
    weights = modes.weights(Gait(group.shapes.seconds))  # of similar size: coarsely stored modes add little error
    np.testing.assert_allclose(np.mean(weights**2, axis=0), 1.0, rtol=1e-4)


def test_bytes_hold_the_modes_of_all_groups_in_order(modes):
    other = Modes(2.0 * modes.shifts[:2], modes.turns[:2], modes.weights)
    stored, largest = modes_array(["a", "rigid", "b"], {"b": modes, "a": other}, len(modes.shifts))
    count = modes.shifts.shape[1]
    assert stored.shape == (2 * count, len(modes.shifts), 2, 3) and stored.dtype == np.int8
    values = largest * stored * np.abs(stored.astype(float)) / 127.0**2
    expected = np.stack([modes.shifts, modes.turns], axis=2).transpose(1, 0, 2, 3)
    np.testing.assert_allclose(values[count:], expected, atol=largest / 60)
    np.testing.assert_allclose(values[:count, :2, 0], 2.0 * expected[:, :2, 0], atol=largest / 60)
    assert (values[:count, 2:] == 0.0).all()


def ahead_of_the_camera() -> tuple[Deformable, SplatModel]:
    """A person who crosses what `oblique_frame` sees, six metres ahead of it, and the street around."""
    pose = oblique_frame().camera_to_world
    place = pose[:3, 3] + 5.0 * pose[:3, 2] - 1.2 * pose[:3, 0]
    right = float(np.arctan2(pose[1, 0], pose[0, 0]))
    people = walker(walking((place[0], place[1], place[2]), right, 0.9), count=150, strength=0.08)
    with torch.no_grad():
        people.params["scales"].fill_(np.log(0.08))
        people.params["opacities"].fill_(1.0)
    return people, SplatModel([people], None)


@in_a_browser
def test_people_walk_as_recorded_and_as_edited(opened):
    street, sky, frame = splats(60, sh_degree=1), a_sky(), oblique_frame()
    people, model = ahead_of_the_camera()
    motion = people.timeline.tracks[0].motion
    seconds = np.linspace(0.0, 2.0, 61)
    sampled = SampledMotion(seconds, motion.poses(seconds), ((0.0, 2.0),), 0.0)
    shown = people.rigid_groups(0.0)[TURNING].gaussians
    group = SampledGroup(shown, sampled, None, sampled_shapes(model, TURNING, sampled))
    still = np.repeat(motion.poses(np.array([1.0])), 61, axis=0)
    moved = InstanceMotion(seconds, still, 0.4 * seconds, ((0.0, 2.0),))
    slowed = Instance("slowed", TURNING, "human.pedestrian.adult", np.array(SIZE), 1.0, moved, phase=0.5)
    groups = {"background": SampledGroup(street), TURNING: group}
    content = ViewerContent(
        groups, sky, False, path_from(frame), [SampledEdit("slowed", (slowed,), None)],
        modes=fitted_modes(model, groups),
    )  # fmt: skip

    def expected(second: float, shape: dict[str, float] | None = None, place: float | None = None) -> np.ndarray:
        pose = motion.poses(np.array([second if place is None else place]))[0]
        placement = ActorPlacement(TURNING, object_to_world=pose, **(shape or {}))
        with torch.no_grad():
            person = sampled_with(people, second, [placement])
        return rendered(a_model(concatenate([street, person]), sky), frame.camera_to_world)

    with opened(viewer_page(content, "test", {})) as tab:
        tab.run(click("follow"))
        for second in (0.4, 1.3):
            tab.run(set_second(second))
            walked = float(motion.walked(np.array([second]))[0])
            assert psnr(settled(tab), expected(second, {"walked": walked})) > 36.0
            assert psnr(settled(tab), expected(second, {"walked": walked - 0.7})) < 32.0, "another moment of the gait"
        tab.run(f"{set_second(1.5)}; {choose('edit', 0)}")
        assert psnr(settled(tab), expected(1.5, {"walked": 0.6, "phase": 0.5}, 1.0)) > 36.0
        assert psnr(settled(tab), expected(1.5, {"walked": 0.6}, 1.0)) < 32.0


def means_in_box(people: Deformable, second: float) -> np.ndarray:
    return in_box(people, second).means.detach().numpy()


@pytest.fixture(scope="module")
def groups(model, scene) -> dict[str, SampledGroup]:
    return trained_groups(model, scene, NO_TIMES)


def test_shapes_are_those_of_the_model_and_others_at_other_times(model, people, groups):
    shapes = groups[TURNING].shapes
    assert groups["background"].shapes is None, "what is rigid has none"
    assert all(part.shapes("nobody", [0.0]) is None for part in model.parts)
    assert shapes is not None and shapes.means.shape == (len(shapes.seconds), 30, 3)
    for second, means in zip(shapes.seconds, shapes.means, strict=True):
        np.testing.assert_allclose(means, means_in_box(people, float(second)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(shapes.quats, axis=-1), 1.0, atol=1e-6)
    assert np.abs(shapes.means - shapes.means[0]).max() > 0.05


def test_thinned_or_dropped_gaussians_leave_the_others_their_own_shapes(people, scene, groups):
    kept, whole = thinned_groups(groups, 12)[TURNING], groups[TURNING]
    rows = [int((whole.gaussians.means == mean).all(dim=1).nonzero()) for mean in kept.gaussians.means]
    assert 0 < len(rows) < 30
    np.testing.assert_array_equal(kept.shapes.means, whole.shapes.means[:, rows])
    np.testing.assert_array_equal(kept.shapes.quats, whole.shapes.quats[:, rows])
    params = {name: value.detach().clone() for name, value in people.params.items()}
    broken = Deformable(params, people.timeline.tracks, people.settings, GaussianSettings())
    with torch.no_grad():
        broken.params["opacities"][4] = torch.nan
    finite = trained_groups(SplatModel([broken], None), scene, NO_TIMES)[TURNING]
    assert len(finite.gaussians) == 29 and finite.shapes.means.shape[1] == 29


def test_usd_plays_positions_orientations_and_extents(people, scene, groups, tmp_path):
    write_usdz(tmp_path / "a.usdz", splat_stage(groups, [(0.0, Gf.Camera())], {}))
    stage = Usd.Stage.Open(str(tmp_path / "a.usdz"))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath(f"/World/actors/_{TURNING}"))
    shapes = groups[TURNING].shapes
    for i in range(0, len(shapes.seconds), 7):
        code = Usd.TimeCode(float(shapes.seconds[i]) * 30.0)
        positions = np.array(splat.GetPositionsAttr().Get(code))
        np.testing.assert_allclose(positions, means_in_box(people, float(shapes.seconds[i])), atol=1e-5)
        real = np.array([quat.GetReal() for quat in splat.GetOrientationsAttr().Get(code)])
        np.testing.assert_allclose(real, shapes.quats[i, :, 0], atol=1e-5)
        low, high = np.array(splat.GetExtentAttr().Get(code))
        assert (low < positions).all() and (positions < high).all()
    shown = scene.seconds(shown_timestamp(scene, None))
    np.testing.assert_allclose(np.array(splat.GetPositionsAttr().Get()), means_in_box(people, shown), atol=1e-5)
    still = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/World/background"))
    assert still.GetPositionsAttr().GetNumTimeSamples() == 0


def test_a_ply_shows_the_time_that_was_asked_for(model, people, scene):
    for second in (0.25, 1.0):
        own = trained_groups(model, scene, NO_TIMES, second)[TURNING].gaussians
        np.testing.assert_allclose(own.means.numpy(), means_in_box(people, second), atol=1e-6)
        together = trained_gaussians(model, scene, second)
        expected = sampled(people, second).means.detach()
        np.testing.assert_allclose(together.means[-30:].detach().numpy(), expected.numpy(), atol=1e-5)
