"""Objects that deform, in the viewer: their modes, and what the page shows of them, as recorded and edited."""

import numpy as np
import pytest
import torch
from helpers.chromium import chromium, in_a_browser
from helpers.hand_made import round_gaussians
from helpers.hand_made_traffic import TURNING, with_turning_track
from helpers.samples import sampled_with
from helpers.viewer_pages import (
    HEIGHT,
    SHOWN_WITHOUT_WORDS,
    WIDTH,
    a_model,
    a_sky,
    choose,
    oblique_frame,
    path_from,
    psnr,
    rendered,
    set_second,
    settled,
    splats,
)
from helpers.walkers import SIZE, walker, walking
from scipy.spatial.transform import Rotation

from drivesplat.export.modes import Gait, Modes, fitted_modes
from drivesplat.export.sampled_motion import SampledMotion
from drivesplat.export.trained_parts import SampledGroup, sampled_shapes, trained_groups
from drivesplat.export.viewer import viewer_page
from drivesplat.export.viewer_scene import ViewerContent, modes_array
from drivesplat.kernels.placement import LocalGaussians
from drivesplat.model.actor_placements import ActorPlacement, with_walked
from drivesplat.model.deformable import Deformable
from drivesplat.model.gaussians import concatenate
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.timeline import TimeState
from drivesplat.trajectories.sampled_edit import Instance, InstanceMotion, SampledEdit

EDITED = {"walked": 0.7, "scale": 1.25, "phase": 0.3}


@pytest.fixture(scope="module")
def people() -> Deformable:
    return walker(strength=0.05)


@pytest.fixture(scope="module")
def model(people) -> SplatModel:
    return SplatModel([round_gaussians([[1.0, 2.0, 3.0]], sizes=0.5), people], None)


@pytest.fixture(scope="module")
def group(model, tiny_scene) -> SampledGroup:
    return trained_groups(model, with_turning_track(tiny_scene), np.array([], dtype=np.int64), 1.0)[TURNING]


@pytest.fixture(scope="module")
def modes(model, group) -> Modes:
    return fitted_modes(model, {TURNING: group})[TURNING]


def in_box(people: Deformable, second: float, **placement: float) -> LocalGaussians:
    """The Gaussians that the model places in the box, as recorded or with changes of their gait."""
    state, there = TimeState(*people.state(second).now), [ActorPlacement(TURNING, **placement)]
    return people.local(with_walked(state, people.ids, there, people.cycle_lengths))


def turned_by(quats: torch.Tensor, turns: np.ndarray, others: torch.Tensor) -> np.ndarray:
    """The angles (radians) between `quats`, turned by vectors as modes give them, and `others`."""
    turn = Rotation.from_quat(np.hstack([np.ones((len(turns), 1)), turns]), scalar_first=True)
    found = turn * Rotation.from_quat(quats.detach().numpy(), scalar_first=True)
    return (found.inv() * Rotation.from_quat(others.detach().numpy(), scalar_first=True)).magnitude()


@pytest.mark.parametrize("changes", [{}, EDITED])
@pytest.mark.parametrize("second", [0.3, 1.0, 2.7])
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


def test_weights_are_of_similar_size(modes, group):
    """So that modes that are stored coarsely add little error."""
    weights = modes.weights(Gait(group.shapes.seconds))
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
def test_people_walk_as_recorded_and_as_edited(tmp_path):
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
    file = tmp_path / "viewer.html"
    file.write_text(viewer_page(content, "test", {}), encoding="utf-8")

    def expected(second: float, shape: dict[str, float] | None = None, place: float | None = None) -> np.ndarray:
        pose = motion.poses(np.array([second if place is None else place]))[0]
        placement = ActorPlacement(TURNING, object_to_world=pose, **(shape or {}))
        with torch.no_grad():
            person = sampled_with(people, second, [placement])
        return rendered(a_model(concatenate([street, person]), sky), frame.camera_to_world)

    with chromium(tmp_path / "profile") as tab:
        tab.open(file, WIDTH, HEIGHT)
        tab.run(SHOWN_WITHOUT_WORDS)
        for second in (0.4, 1.3):
            tab.run(set_second(second))
            walked = float(motion.walked(np.array([second]))[0])
            assert psnr(settled(tab), expected(second, {"walked": walked})) > 36.0
            assert psnr(settled(tab), expected(second, {"walked": walked - 0.7})) < 32.0, "another moment of the gait"
        tab.run(f"{set_second(1.5)}; {choose('edit', 0)}")
        assert psnr(settled(tab), expected(1.5, {"walked": 0.6, "phase": 0.5}, 1.0)) > 36.0
        assert psnr(settled(tab), expected(1.5, {"walked": 0.6}, 1.0)) < 32.0
        assert tab.complaints == []
