"""Actors whose limbs move: the lattice that deforms them, the phase of their gait, and what edits do to it."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from helpers.hand_made import actor_record, actors_of, motion_through, track_of
from helpers.records import training_record_of
from helpers.samples import sampled, sampled_with

from drivesplat.kernels.quaternions import rotation_matrix
from drivesplat.model.build import ModelInit, build_model, definitions, rebuild_model
from drivesplat.model.deformable import Deformable, Lattice, Undeformed, roughness
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.harmonics import rotated
from drivesplat.model.states import SCAN, ActorPlacement, State
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.settings.deformable import GaitSettings, LatticeSettings
from drivesplat.settings.train import GaussianSettings, TrainSettings
from drivesplat.settings.train_objects import DeformableSettings
from drivesplat.trajectories.motion import HALF_STEP

SIZE, SPEED = (0.8, 0.6, 1.8), 1.5
STRIDE = 0.83 * SIZE[2]
NODES = (3, 4, 5)
LATTICE = LatticeSettings(nodes=NODES)
TIMES = 0.5 * np.arange(9)


def walker(name: str = "walker", speed: float = SPEED) -> ActorTrack:
    """Walks along x for four seconds."""
    return track_of(motion_through(TIMES, [[speed * t, 2.0, 0.9] for t in TIMES], 0.0 * TIMES), name, SIZE)


def people_of(*tracks: ActorTrack, seed: int = 0, **changes) -> Deformable:
    """A part with 40 Gaussians for each track, and random deformations."""
    rng, settings = np.random.default_rng(seed), DeformableSettings(**{"lattice": LATTICE, **changes})
    points = [rng.uniform(-0.5, 0.5, (40, 3)) * track.size for track in tracks]
    colors = [rng.uniform(0.0, 1.0, (40, 3)) for _ in tracks]
    part = Deformable.from_points(tracks, points, colors, settings, GaussianSettings())
    if "lattice" in part.shared:
        with torch.no_grad():
            part.shared["lattice"] += 0.1 * torch.from_numpy(rng.normal(size=part.shared["lattice"].shape)).float()
    return part


def time_state(part: Deformable, time: float) -> TimeState:
    return TimeState(*part.state(time).now)


def in_box(part: Deformable, time: float) -> torch.Tensor:
    return part.local(time_state(part, time)).means.detach()


# ---- the lattice


def moved_by(nodes: torch.Tensor, basis: torch.Tensor, gaussians: Undeformed) -> torch.Tensor:
    """The shifts and turns (n, 6) of Gaussians by lattices."""
    lattice = Lattice(LATTICE, np.ones(nodes.shape[1]))
    return torch.cat(lattice.deformation(nodes, gaussians, basis), dim=1)


def points_and_owners(n: int = 20) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Points of two objects in boxes of different sizes: positions, owners (as numbers and one-hot), half sizes."""
    generator = torch.Generator().manual_seed(0)
    owner = torch.arange(n) % 2
    reach = torch.tensor([[1.0, 0.5, 2.0], [0.4, 0.3, 0.9]]).double()
    means = (2.0 * torch.rand(n, 3, generator=generator).double() - 1.0) * reach[owner]
    return means, owner, torch.nn.functional.one_hot(owner, 2).double(), reach


def test_a_lattice_reproduces_linear_deformations():
    """Trilinear interpolation is exact for x -> A x + b, with its own A and b for each object and function."""
    means, owner, owns, reach = points_and_owners()
    generator = torch.Generator().manual_seed(1)
    slopes, shifts = (torch.randn(2, 2, *s, generator=generator).double() for s in ((6, 3), (6,)))
    axes = [torch.linspace(-1.0, 1.0, count).double() for count in NODES]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)[None] * reach[:, None, None, None]
    linear = torch.einsum("akdc,axyzc->akxyzd", slopes, grid) + shifts[:, :, None, None, None]
    basis = torch.randn(2, 2, generator=generator).double()
    found = moved_by(linear, basis, Undeformed(means, owner, owns, reach))
    own = torch.einsum("nkdc,nc->nkd", slopes[owner], means) + shifts[owner]
    torch.testing.assert_close(found, (basis[owner][:, :, None] * own).sum(dim=1))


def test_points_outside_the_box_move_with_its_surface():
    _, _, _, reach = points_and_owners()
    owner = torch.tensor([1, 1, 1])
    means = torch.stack([reach[1], 3.0 * reach[1], torch.tensor([0.4, 9.0, 0.9]).double()])
    coefficients = torch.randn(2, 1, *NODES, 6, generator=torch.Generator().manual_seed(2)).double()
    owns = torch.nn.functional.one_hot(owner, 2).double()
    moved = moved_by(coefficients, torch.ones(2, 1).double(), Undeformed(means, owner, owns, reach))
    assert (moved == coefficients[1, 0, -1, -1, -1]).all()


def test_gradients_of_the_lattice_are_those_of_finite_differences():
    means, owner, owns, reach = points_and_owners(6)
    generator = torch.Generator().manual_seed(3)
    inputs = [torch.randn(2, 2, *size, generator=generator).double() for size in ((*NODES, 6), ())]
    inputs = [value.requires_grad_() for value in (*inputs, means)]

    def moved(coefficients, basis, points):
        return moved_by(coefficients, basis, Undeformed(points, owner, owns, reach))

    assert torch.autograd.gradcheck(moved, inputs, fast_mode=True)


def test_roughness_is_the_mean_squared_difference_between_neighbours_and_has_its_gradient():
    nodes = torch.randn(2, 3, *NODES, 6, generator=torch.Generator().manual_seed(5)).double().requires_grad_()
    expected = sum(nodes.diff(dim=axis).square().mean(dim=(0, 2, 3, 4, 5)).sum() for axis in (2, 3, 4))
    torch.testing.assert_close(roughness(nodes), expected)
    assert torch.autograd.gradcheck(roughness, nodes, fast_mode=True)


# ---- the part


def test_without_displacements_it_is_a_rigid_actor():
    tracks = walker(), walker("other", -2.0)
    part = people_of(*tracks, fourier=5, sh_degree=1)
    rigid = actors_of(*tracks, count=40, shaken=False)
    with torch.no_grad():
        part.shared["lattice"].zero_()
        for name, values in rigid.params.items():
            values.copy_(part.params[name])
    for found, expected in zip(sampled(part, 1.3).tensors.values(), sampled(rigid, 1.3).tensors.values(), strict=True):
        torch.testing.assert_close(found, expected)
    torch.testing.assert_close(sampled(part, 1.3, SCAN).velocities, sampled(rigid, 1.3, SCAN).velocities)


def test_the_limbs_return_after_a_stride():
    part = people_of(walker(), fourier=1)
    cycle = STRIDE / SPEED
    torch.testing.assert_close(in_box(part, 0.4 + cycle), in_box(part, 0.4), atol=1e-4, rtol=0.0)
    assert (in_box(part, 0.4 + 0.5 * cycle) - in_box(part, 0.4)).norm(dim=1).median() > 0.05
    first, last = (part.cycles(time_state(part, at)).detach() for at in (0.4, 0.4 + cycle))
    assert float(last - first) == pytest.approx(1.0)


def test_a_cyclist_pedals_less_often_than_a_person_steps():
    cyclist = dataclasses.replace(walker("cyclist"), object_class="rider")
    lengths = people_of(walker(), cyclist).cycle_lengths.tolist()
    assert lengths == pytest.approx([STRIDE, 3.0 * SIZE[2]])
    own = GaitSettings(strides={"rider": 2.0})
    assert people_of(walker(), cyclist, gait=own).cycle_lengths.tolist() == pytest.approx([STRIDE, 2.0 * SIZE[2]])


def test_the_limbs_of_who_stands_change_with_time_alone():
    still = people_of(walker(speed=0.0))
    assert torch.equal(in_box(still, 0.3), in_box(still, 2.9)), "the default"
    gestures = people_of(walker(speed=0.0), fourier=5)
    assert (in_box(gestures, 0.3) - in_box(gestures, 2.9)).norm(dim=1).median() > 0.05


def test_a_longer_stride_and_a_correction_change_the_phase():
    part = people_of(walker())
    walked = SPEED * 2.25
    with torch.no_grad():
        part.shared["stride"].fill_(math.log(1.25))
        part.shared["phase"].copy_(0.1 * torch.arange(9))
    recorded, far = time_state(part, 2.25), time_state(part, 2.0)._replace(walked=torch.tensor([1000.0]))
    assert float(part.cycles(recorded).detach()) == pytest.approx(walked / (1.25 * STRIDE) + 0.45, abs=1e-4)
    last = 1000.0 / (1.25 * STRIDE) + 0.8  # the last correction holds
    assert float(part.cycles(far).detach()) == pytest.approx(last, abs=1e-3)


def test_gaussians_turn_with_their_limb():
    part = people_of(walker(), fourier=1)
    with torch.no_grad():
        part.shared["lattice"].zero_()
        part.shared["lattice"][:, 0, ..., 4] = math.tan(0.15)  # 0.3 rad about the y axis at phase 0
    state = time_state(part, 0.0)
    turned = rotation_matrix(torch.nn.functional.normalize(part.local(state).quats, dim=1)).detach()
    assert turned[:, 0, 2].mean() == pytest.approx(math.sin(0.3), abs=1e-5)


@pytest.mark.parametrize("degree", [0, 1])
def test_a_mirrored_person_is_the_mirror_image_of_half_a_cycle_later(degree):
    """Of two people, who walk along x, the first is mirrored: places, shapes and colours."""
    part = people_of(walker("first"), walker("second", 1.1), sh_degree=degree)
    part.mirrored = torch.full((2,), 0.5)
    with torch.no_grad():
        part.params["shN"].normal_(generator=torch.Generator().manual_seed(6))
    state, half = time_state(part, 1.3), torch.tensor([0.5 * STRIDE, 0.0])
    later, sides = state._replace(walked=state.walked + half), state._replace(side=torch.tensor([-1.0, 1.0]))
    places = part.posed(state).poses.translations[part.params["owner"]]
    seen = [part.sample(State(each)) for each in (state, later, sides)]
    here, expected, found = (gaussians.means.detach() - places for gaussians in seen)
    _, covariances, mirrored = map(covariances_of, seen)
    _, colors, shown = (gaussians.sh.detach() for gaussians in seen)
    mirror, first = torch.diag(torch.tensor([1.0, -1.0, 1.0])), part.of_track("first")
    torch.testing.assert_close(found[first], expected[first] @ mirror, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(mirrored[first], mirror @ covariances[first] @ mirror, atol=1e-6, rtol=1e-4)
    torch.testing.assert_close(shown[first], rotated(colors[first], mirror), atol=1e-5, rtol=0.0)
    for ours, theirs in ((found, here), (mirrored, covariances), (shown, colors)):
        assert torch.equal(ours[~first], theirs[~first])
    assert (found - here)[first].norm(dim=1).median() > 0.1


def covariances_of(gaussians: Gaussians) -> torch.Tensor:
    axes = rotation_matrix(gaussians.quats) * gaussians.scales[:, None]
    return (axes @ axes.mT).detach()


@pytest.mark.parametrize(
    ("times", "places"),
    [
        pytest.param([2.0], [[1.0, 2.0, 0.9]], id="one annotation"),
        pytest.param([0.0, 0.5], [[1.0, 2.0, 0.9], [1.0, 2.0, 0.9]], id="stands"),
        pytest.param([0.0, 0.5, 1.0], [[0.0, 0.0, 0.9], [500.0, 0.0, 0.9], [0.5, 0.0, 0.9]], id="jumps"),
    ],
)
def test_odd_tracks_have_finite_gaussians_and_gradients(times, places):
    part = people_of(track_of(motion_through(times, places, np.zeros(len(times))), "odd", SIZE), walker())
    sampled(part, times[-1]).means.square().sum().backward()
    learned = [value for value in (*part.params.values(), *part.shared.values()) if value.grad is not None]
    assert learned and all(value.grad.isfinite().all() for value in learned)
    assert sampled(part, times[-1], SCAN).velocities.isfinite().all()


def test_velocities_include_those_of_limbs():
    part, step = people_of(walker()), HALF_STEP
    expected = (sampled(part, 1.3 + step).means - sampled(part, 1.3 - step).means) / (2.0 * step)
    torch.testing.assert_close(sampled(part, 1.3, SCAN).velocities, expected.detach(), atol=1e-3, rtol=1e-3)
    assert (sampled(part, 1.3, SCAN).velocities[:, 0] - SPEED).abs().max() > 0.1


def test_edited_actors_move_their_limbs_by_the_distance_that_they_walk():
    """Copies have their own phase, and scaled people take scaled steps."""
    part, pose = people_of(walker(), fourier=1), walker().motion.poses(np.array([1.0]))[0]
    recorded = sampled(part, 1.0).means.detach()

    def at(time: float = 1.0, at_pose: np.ndarray = pose, **placement) -> torch.Tensor:
        return sampled_with(part, time, [ActorPlacement("walker", at_pose, **placement)]).means.detach()

    for found in (at(walked=SPEED), at(2.7, walked=SPEED), at(2.7, walked=SPEED + STRIDE)):
        torch.testing.assert_close(found, recorded, atol=1e-3, rtol=0.0)
    assert (at(walked=SPEED + 0.5 * STRIDE) - recorded).norm(dim=1).median() > 0.05
    torch.testing.assert_close(at(walked=1.0, phase=0.25), at(walked=1.0 + 0.25 * STRIDE), atol=1e-5, rtol=0.0)
    enlarged = at(at_pose=np.eye(4), walked=2.0, scale=2.0)
    torch.testing.assert_close(enlarged, 2.0 * at(at_pose=np.eye(4), walked=1.0), atol=1e-5, rtol=0.0)
    copies = [ActorPlacement("walker", pose, walked=1.0), ActorPlacement("walker", pose, walked=1.0, phase=0.5)]
    first, second = sampled_with(part, 1.0, copies).means.detach().split(40)
    torch.testing.assert_close(first, at(walked=1.0))
    torch.testing.assert_close(second, at(walked=1.0, phase=0.5))


def test_a_placement_that_stands_has_no_velocity_and_one_that_walks_on_the_spot_only_that_of_its_limbs():
    part, pose = people_of(walker(), fourier=1), np.eye(4)
    standing = ActorPlacement("walker", pose, around=(pose, pose), walked=2.0, walked_around=(2.0, 2.0))
    assert sampled_with(part, 1.0, [standing], SCAN).velocities.abs().max() < 1e-4
    beside = (2.0 - HALF_STEP * SPEED, 2.0 + HALF_STEP * SPEED)
    walking = ActorPlacement("walker", pose, around=(pose, pose), walked=2.0, walked_around=beside)
    assert sampled_with(part, 1.0, [walking], SCAN).velocities.abs().max() > 0.1


def test_penalties_grow_with_displacements_and_their_order():
    part = people_of(walker(), fourier=5, gait=GaitSettings(harmonics=3))
    squared_orders = [1, 1, 4, 4, 9, 9, 1, 4, 9, 16]
    assert part.shared["lattice"].shape[1] == len(squared_orders)
    sizes = []
    for function in range(len(squared_orders)):
        with torch.no_grad():
            part.shared["lattice"].zero_()
            part.shared["lattice"][:, function] = 0.1
        found = part.penalties()
        assert float(found["lattice_roughness"].detach()) == 0.0
        sizes.append(float(found["lattice_size"].detach()))
    np.testing.assert_allclose(np.array(sizes) / sizes[0], squared_orders, rtol=1e-5)


def test_a_part_is_built_of_its_own_objects_and_survives_a_checkpoint():
    tracks = {"car": ("actors",), "rider": ("deformable", "actors"), "walker": ("deformable",)}
    records = [
        actor_record(track_of(motion_through(TIMES, [[t, i, 0.9] for t in TIMES], 0.0 * TIMES), name, SIZE))
        for i, name in enumerate(tracks)
    ]
    records = [type(r)(**{**vars(r), "parts": parts}) for r, parts in zip(records, tracks.values(), strict=True)]
    init, settings = ModelInit(training_record_of(3), records, np.full(3, 0.5)), TrainSettings()
    rigid = build_model(init, ("background", "actors"), "none", settings)
    assert [track.id for track in rigid.parts[1].timeline.tracks] == ["car", "rider"]
    parts = ("background", "actors", "deformable")
    model = build_model(init, parts, "none", settings)
    assert [[t.id for t in part.timeline.tracks] for part in model.parts[1:]] == [["car"], ["rider", "walker"]]
    with torch.no_grad():
        model.parts[2].shared["lattice"].normal_(0.0, 0.1, generator=torch.Generator().manual_seed(4))
    again = rebuild_model(model.state_dict(), definitions(model), "none", settings)
    for found, expected in zip(again.at(1.1).tensors.values(), model.at(1.1).tensors.values(), strict=True):
        assert torch.equal(found, expected)


def penalty_of_lattices(objects: int, images: int, scans: int = 0) -> dict[str, float]:
    """The penalties of a model whose objects all deform alike."""
    paths = [motion_through(TIMES, [[t, i, 0.9] for t in TIMES], 0.0 * TIMES) for i in range(objects)]
    records = [actor_record(track_of(path, f"walker {i}", SIZE)) for i, path in enumerate(paths)]
    records = [dataclasses.replace(record, parts=("deformable",)) for record in records]
    init = ModelInit(training_record_of(images), records, np.full(3, 0.5), scans=scans)
    part = build_model(init, ("background", "deformable"), "none", TrainSettings()).parts[1]
    with torch.no_grad():
        part.shared["lattice"][:, 0, 0] = 0.1
    return {name: float(part.penalties()[name].detach()) for name in ("lattice_size", "lattice_roughness")}


def test_lattices_are_penalised_by_object_and_less_the_more_images_there_are():
    """As the colour loss, whose mean over images has a share of each object that does not depend on other objects."""
    for name, expected in penalty_of_lattices(1, 4).items():
        assert expected > 0.0
        assert penalty_of_lattices(3, 4)[name] == pytest.approx(3.0 * expected)
        assert penalty_of_lattices(1, 40)[name] == pytest.approx(0.1 * expected)
        assert penalty_of_lattices(1, 0, scans=40)[name] == pytest.approx(0.1 * expected), "a LiDAR alone"
        assert penalty_of_lattices(1, 4, scans=40)[name] == pytest.approx(expected)


@pytest.mark.parametrize(("owner", "name", "row"), [("params", "means", 45), ("shared", "phase", 12)])
def test_tracks_with_a_value_that_is_not_finite_are_named(owner, name, row):
    part = people_of(walker("first"), walker("second"))
    assert part.broken_tracks() == []
    with torch.no_grad():
        getattr(part, owner)[name][row] = math.nan
    assert part.broken_tracks() == ["second"]
