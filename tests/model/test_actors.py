"""Gaussians that ride in moving boxes: where they are, what colours they have, and what corrects their boxes."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z, actors_of, looking_at, motion_through, track_of
from helpers.samples import sampled, sampled_with
from scipy.spatial.transform import Rotation
from torch.nn.functional import one_hot

from drivesplat.kernels.placement import ObjectPoses, colors_in_object
from drivesplat.kernels.quaternions import about_vertical, left_factor, rotated_back, rotation_matrix, turned
from drivesplat.model.actors import Actors
from drivesplat.model.harmonics import rotated
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import ActorPlacement, State
from drivesplat.model.timeline import ActorTrack, TimeState
from drivesplat.settings.train import DefaultSettings, GaussianSettings, McmcSettings
from drivesplat.settings.train_objects import ActorSettings, TrackSettings
from drivesplat.training.optimizers import make_optimizers

TIMES = np.linspace(1.0, 3.0, 5)
"""Of the van's annotations."""
VELOCITY, RATE = np.array([4.0, -1.0, 0.1]), 0.7
"""Metres and radians a second."""


def van() -> ActorTrack:
    """At (4, -1, 0.1) t, its heading 0.7 t, from 1 to 3 seconds."""
    return track_of(motion_through(TIMES, TIMES[:, None] * VELOCITY, RATE * TIMES), "van", (5.0, 2.0, 2.2))


def tilted(track: ActorTrack) -> ActorTrack:
    """The same, its nose 0.3 rad down."""
    poses = track.motion.object_to_world.copy()
    poses[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_euler("y", 0.3).as_matrix()
    return dataclasses.replace(track, motion=dataclasses.replace(track.motion, object_to_world=poses))


def car() -> ActorTrack:
    """Winding from 0 to 1 second and from 2.5 to 3.5."""
    times = np.array([0.0, 0.5, 1.0, 2.5, 3.0, 3.5])
    places = np.random.default_rng(5).uniform(-9, 9, (6, 3))
    return track_of(motion_through(times, places, 0.4 * times**2, runs=((0, 2), (3, 5))), "car")


def matrices(quats: torch.Tensor) -> np.ndarray:
    return Rotation.from_quat(quats.detach().double().numpy(), scalar_first=True).as_matrix()


def doubled(actors: Actors) -> dict[str, np.ndarray]:
    return {name: value.detach().double().numpy() for name, value in (*actors.params.items(), *actors.shared.items())}


def poses_at(actors: Actors, time: float) -> ObjectPoses:
    return actors.posed(actors.state(time).now).poses


def harmonics_at(actors: Actors, time: float) -> torch.Tensor:
    """The coefficients of its colours in the frames of its objects."""
    owns = one_hot(actors.params["owner"], len(actors.ids)).float()
    return colors_in_object(actors.params["sh0"], actors.params["shN"], TimeState(*actors.state(time).now).series, owns)


# ---- mirror images


@pytest.mark.parametrize("degree", [0, 2])
def test_a_mirrored_vehicle_is_its_mirror_image(degree):
    """In the frame of its box: what is at y is at -y, in its shape and its colours. The other vehicle stays."""
    actors = actors_of(van(), car(), settings=ActorSettings(sh_degree=degree))
    actors.mirrored = torch.full((2,), 0.5)
    state = TimeState(*actors.state(2.7).now)
    here, found = (actors.sample(State(each)) for each in (state, state._replace(side=torch.tensor([-1.0, 1.0]))))
    pose, rows = actors.posed(state).poses, actors.of_track("van")
    turn, place = torch.from_numpy(matrices(pose.quats)[0]).float(), pose.translations[0].detach()
    reflected = turn @ torch.diag(torch.tensor([1.0, -1.0, 1.0])) @ turn.T
    for name, values in here.tensors.items():
        assert torch.equal(found.tensors[name][~rows], values[~rows]), name
    expected = (here.means[rows].detach() - place) @ reflected + place
    torch.testing.assert_close(found.means[rows].detach(), expected, atol=1e-4, rtol=0.0)
    axes, mirrored = (
        torch.from_numpy(matrices(own.quats[rows])).float() * own.scales[rows, None] for own in (here, found)
    )
    covariances = reflected @ axes @ axes.mT @ reflected
    torch.testing.assert_close((mirrored @ mirrored.mT).detach(), covariances.detach(), atol=1e-4, rtol=1e-4)
    colors = rotated(here.sh[rows].detach(), reflected)
    torch.testing.assert_close(found.sh[rows].detach(), colors, atol=1e-4, rtol=0.0)


# ---- rotations


def test_quaternions_rotate_as_scipys_do():
    """A turn is the axis times the tangent of half the angle: half the rotation vector where it is small."""
    first, second, vectors = (
        Rotation.random(20, random_state=1), Rotation.random(20, random_state=2),
        np.random.default_rng(4).normal(size=(20, 3)),
    )  # fmt: skip
    quats, others = (torch.from_numpy(r.as_quat(scalar_first=True)) for r in (first, second))
    product = (left_factor(quats) @ others[..., None])[..., 0]
    np.testing.assert_allclose(matrices(product), (first * second).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation_matrix(quats), first.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotated_back(quats, torch.from_numpy(vectors)), first.inv().apply(vectors), atol=1e-12)
    angles = np.linalg.norm(vectors, axis=1, keepdims=True)
    turns = torch.from_numpy(np.tan(angles / 2.0) * vectors / angles)
    expected = (Rotation.from_rotvec(vectors) * first).as_matrix()
    np.testing.assert_allclose(matrices(turned(1.7 * quats, turns)), expected, atol=1e-12)
    for angle in (0.3, -2.0, np.pi):
        quat = about_vertical(torch.tensor([angle], dtype=torch.float64))
        np.testing.assert_allclose(matrices(quat)[0], about_z(angle), atol=1e-12)


# ---- where they are


@pytest.mark.parametrize("time", [0.8, 1.37, 3.0])
def test_a_turning_actor_is_transformed_by_its_corrected_box(time):
    """Corrections along the world's axes and about the object's vertical, linear in time as its motion is, so that the
    closed form holds between annotations, too."""
    actors = actors_of(van())
    shift, turn = np.array([0.1, -0.2, 0.05]), 0.11
    with torch.no_grad():
        actors.shared["translation"].copy_(torch.from_numpy(TIMES[:, None] * shift - 0.3))
        actors.shared["yaw"].copy_(torch.from_numpy(turn * TIMES - 0.2))
    p, gaussians = doubled(actors), sampled(actors, time)
    box = about_z(RATE * time + turn * time - 0.2)
    means = p["means"] @ box.T + time * VELOCITY + time * shift - 0.3
    np.testing.assert_allclose(gaussians.means.detach(), means, atol=1e-5)
    np.testing.assert_allclose(matrices(gaussians.quats), box @ matrices(actors.params["quats"]), atol=1e-5)
    np.testing.assert_allclose(gaussians.scales.detach(), np.exp(p["scales"]), rtol=1e-5)
    np.testing.assert_allclose(gaussians.opacities.detach(), 1.0 / (1.0 + np.exp(-p["opacities"])), rtol=1e-5)


@pytest.mark.parametrize("time", [1.0, 1.8, 3.0])
def test_corrections_hold_at_their_annotations_and_are_weighted_between_them_as_positions_are(time):
    """Whatever those of its neighbours are; a box that is tilted, too, is turned about its own vertical."""
    actors = actors_of(tilted(van()))
    weights = van().motion.weights(np.array([time]))[0]
    p, gaussians = doubled(actors), sampled(actors, time)
    tilt = Rotation.from_euler("y", 0.3).as_matrix()
    box = about_z(RATE * time) @ tilt @ about_z(weights @ p["yaw"])
    means = p["means"] @ box.T + time * VELOCITY + weights @ p["translation"]
    np.testing.assert_allclose(gaussians.means.detach(), means, atol=1e-5)
    np.testing.assert_allclose(matrices(gaussians.quats), box @ matrices(actors.params["quats"]), atol=1e-5)


def test_actors_can_be_placed_anywhere_and_enlarged():
    actors = actors_of(van(), car())
    turns = Rotation.random(2, random_state=3)
    places, scales = np.array([[1.0, 2.0, 3.0], [-4.0, 0.0, 1.0]]), np.array([1.5, 0.5])
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns.as_matrix(), places
    there = zip(("van", "car"), poses, scales, strict=True)
    gaussians, p = sampled_with(actors, 9.0, [ActorPlacement(*each) for each in there]), doubled(actors)
    for i, rotation in enumerate(turns.as_matrix()):
        own = p["owner"] == i
        means = scales[i] * p["means"][own] @ rotation.T + places[i]
        np.testing.assert_allclose(gaussians.means[own].detach(), means, atol=1e-5)
        np.testing.assert_allclose(gaussians.scales[own].detach(), scales[i] * np.exp(p["scales"][own]), rtol=1e-5)
        own_turns = matrices(actors.params["quats"])[own]
        np.testing.assert_allclose(matrices(gaussians.quats[own]), rotation @ own_turns, atol=1e-5)
    assert (gaussians.opacities > 0).all(), "absent by their tracks at this time, present where they are put"


@pytest.mark.parametrize(
    ("time", "there"),
    [(0.9, [True, True]), (2.0, [True, False]), (7.0, [False, False])],
)
def test_absent_actors_keep_their_rows_and_have_no_opacity(time, there):
    actors = actors_of(van(), car(), count=7)
    gaussians = sampled(actors, time)
    assert len(gaussians) == len(actors) == 14
    assert actors.params["owner"].tolist() == [0] * 7 + [1] * 7
    for i, present in enumerate(there):
        opacities = gaussians.opacities[actors.params["owner"] == i]
        assert (opacities > 0).all() if present else (opacities == 0).all()
    assert all(torch.isfinite(value).all() for value in gaussians.tensors.values())


def alone(actors: Actors, index: int, settings: ActorSettings) -> Actors:
    """One of several actors with its Gaussians and corrections."""
    own = actors.params["owner"] == index
    params = {name: value.detach()[own].clone() for name, value in actors.params.items()}
    params["owner"] = torch.zeros_like(params["owner"])
    one = Actors(params, [actors.timeline.tracks[index]], settings, GaussianSettings())
    with torch.no_grad():
        for name, value in one.shared.items():
            value.copy_(actors.shared[name][actors.timeline.owned[index]])
    return one


@pytest.mark.parametrize("time", [0.9, 3.1])
def test_several_actors_at_once_are_each_as_alone(time):
    settings = ActorSettings(sh_degree=2)
    actors = actors_of(van(), car(), van(), settings=settings, count=5)
    shuffled = torch.randperm(15, generator=torch.Generator().manual_seed(0))
    for value in actors.params.values():
        value.data = value.data[shuffled]
    together = sampled(actors, time)
    for i in range(3):
        one, own = sampled(alone(actors, i, settings), time), together[actors.params["owner"] == i]
        for name in own.tensors:
            torch.testing.assert_close(own.tensors[name], one.tensors[name], rtol=1e-5, atol=1e-6)


# ---- their colours


@pytest.mark.parametrize(("time", "progress"), [(0.8, 0.0), (1.6, 0.3), (3.2, 1.0)])
def test_colours_are_a_series_of_cosines_over_the_annotations(time, progress):
    """Equation 5 of Street Gaussians, for every coefficient; beyond the annotations the ends' colours stay."""
    actors = actors_of(van(), settings=ActorSettings(fourier=4, sh_degree=1))
    p = doubled(actors)
    f = np.concatenate([p["sh0"], p["shN"]], axis=2)
    assert f.shape == (6, 4, 4, 3)
    expected = sum(f[:, i] * np.cos(np.pi * i * progress) for i in range(4))
    np.testing.assert_allclose(harmonics_at(actors, time).detach(), expected, atol=1e-5)


def first_degree(sh: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Colours (n, d, 3) of coefficients (n, 4, 3) along directions (d, 3), in closed form."""
    x, y, z = directions.T
    basis = np.stack([np.full_like(x, 0.28209479), -0.48860251 * y, 0.48860251 * z, -0.48860251 * x], axis=1)
    return np.einsum("dk,nkc->ndc", basis, sh)


def test_an_actor_that_turns_keeps_its_colours_on_its_sides():
    """Seen from the world along d it has the colours that its own frame has along R^T d, whatever corrects its box."""
    actors = actors_of(van())
    rng = np.random.default_rng(4)
    directions = rng.normal(size=(30, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = []
    for time in (1.0, 2.1, 2.9):
        box = matrices(poses_at(actors, time).quats)[0]
        expected = first_degree(harmonics_at(actors, time).detach().double().numpy(), directions @ box)
        seen.append(first_degree(sampled(actors, time).sh.detach().double().numpy(), directions))
        np.testing.assert_allclose(seen[-1], expected, atol=1e-5)
    assert np.abs(seen[0] - seen[1]).max() > 0.1, "turned far enough to tell"


# ---- what corrects their boxes


def in_double(actors: Actors) -> Actors:
    """The same actors, computed in float64."""
    state_at = actors.timeline.at

    def in_float64(time, device):
        state = state_at(time, device)
        return state._replace(**{n: value.double() for n, value in state._asdict().items() if n != "present"})

    actors.timeline.at = in_float64
    return actors.double()


def test_an_image_corrects_positions_and_headings_by_its_gradient():
    """Autograd against finite differences, along random directions of all corrections together, through a rendering
    between annotations. Of one colour all around, since colours turn without a gradient by design."""
    motion = motion_through(
        [0.0, 0.5, 1.0, 1.5], [[4.0 * t, 0.0, 0.0] for t in (0.0, 0.5, 1.0, 1.5)], [0, 0.3, 0.6, 0.9]
    )
    settings = ActorSettings(sh_degree=0, fourier=2)
    actors = in_double(actors_of(track_of(motion, size=(2.0, 1.0, 1.0)), settings=settings, count=8))
    model = SplatModel([actors], None)
    view = looking_at([2.8, 0.0, 0.0], [2.8, -5.0, 1.0], time=0.7, width=18, height=12)
    view = dataclasses.replace(view, K=view.K.double(), camera_to_world=view.camera_to_world.double())
    ramp = torch.linspace(-9.0, 9.0, 18, dtype=torch.float64)[:, None] * torch.tensor([1.0, -2.0, 1.5])

    def loss() -> torch.Tensor:
        return (model.render(view).image * ramp).sum()

    loss().backward()
    for name in ("translation", "yaw"):
        value, gradient, step = actors.shared[name].detach(), actors.shared[name].grad, 1e-6
        assert float(gradient.abs().max()) > 0.1
        for way in torch.randn(2, *value.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64):
            ends = []
            for sign in (1.0, -2.0, 1.0):  # ahead, behind, and back again
                value += sign * step * way
                ends.append(float(loss().detach()))
            assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(float((gradient * way).sum()), rel=1e-5, abs=1e-6)


def test_corrections_learn_at_their_own_rates_and_positions_in_proportion_to_the_middling_size_of_the_boxes():
    tracks = TrackSettings(lr_translation=0.02, lr_yaw=0.03)
    bus = track_of(van().motion, "bus", (12.0, 3.0, 4.0))
    actors = actors_of(van(), car(), bus, settings=ActorSettings(tracks=tracks))
    rates = {name: o.param_groups[0]["lr"] for name, o in make_optimizers(SplatModel([actors], None)).shared[0].items()}
    assert rates == {"translation": 0.02, "yaw": 0.03}
    assert actors.extent == pytest.approx(np.linalg.norm([5.0, 2.0, 2.2]))
    assert actors.learning_rates()["means"] == pytest.approx(1.6e-4 * actors.extent)
    assert all(value.requires_grad for value in actors.penalties().values())


def test_tracks_that_are_not_to_be_corrected_stay_as_they_are():
    actors = actors_of(van(), settings=ActorSettings(tracks=TrackSettings(corrected=False)), shaken=False)
    model = SplatModel([actors], None)
    assert make_optimizers(model).shared == [{}] and actors.penalties() == {}
    model.render(looking_at([8.0, -2.0, 0.0], [8.0, -12.0, 1.0], 2.0)).image.sum().backward()
    assert all(value.grad is None and not value.any() for value in actors.shared.values())
    assert actors.params["means"].grad.abs().sum() > 0


def penalties_of(translation: np.ndarray, yaw: np.ndarray, *tracks: ActorTrack, **settings: float) -> dict[str, float]:
    actors = actors_of(*tracks, settings=ActorSettings(tracks=TrackSettings(**settings)), shaken=False)
    with torch.no_grad():
        actors.shared["translation"].copy_(torch.from_numpy(translation))
        actors.shared["yaw"].copy_(torch.from_numpy(yaw))
    return {name: float(value.detach()) for name, value in actors.penalties().items()}


def test_penalties_are_mean_squares_in_units_of_the_annotation_error():
    rng = np.random.default_rng(7)
    translation, yaw = rng.normal(size=(5, 3)), rng.normal(size=5)
    found = penalties_of(
        translation, yaw, van(), sigma_translation=0.2, sigma_yaw=0.05, l2_weight=0.3, smoothness_weight=0.7
    )
    size = np.mean([(np.sum(translation[i] ** 2) / 0.2**2 + yaw[i] ** 2 / 0.05**2) for i in range(5)])
    bends = [(values[:-2] - 2 * values[1:-1] + values[2:]) ** 2 for values in (translation / 0.2, yaw / 0.05)]
    bend = np.mean([bends[0][i].sum() + bends[1][i] for i in range(3)])
    assert found == pytest.approx({"track_size": 0.3 * size, "track_bend": 0.7 * bend}, rel=1e-5)


def test_linear_corrections_have_no_bend_penalty():
    """The van's, and those of the car's two runs: across its gap, and from track to track, they may leap. There is none
    of two annotations."""
    steady = np.concatenate([np.arange(5.0), 20.0 + 3.0 * np.arange(3), -7.0 - np.arange(3)])
    found = penalties_of(steady[:, None] * [0.1, -0.2, 0.3], 0.01 * steady, van(), car())
    assert found["track_bend"] == pytest.approx(0.0, abs=1e-9) and found["track_size"] > 1.0
    pair = track_of(motion_through([0.0, 0.5], [[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    assert penalties_of(np.ones((2, 3)), np.ones(2), pair).keys() == {"track_size"}


# ---- what else they are asked


def test_only_gaussians_outside_their_own_enlarged_box_fade():
    """The van's box is 5 x 2 x 2.2 m, the car's 4 x 2 x 1.6 m, both grown by 0.1 m on every side."""
    cases = [
        (0, (2.58, 0.0, 0.0), False), (0, (2.62, 0.0, 0.0), True), (1, (2.05, 0.9, 0.0), False),
        (1, (2.55, 0.0, 0.0), True), (0, (0.0, -1.05, 0.0), False), (0, (0.0, -1.15, 0.0), True),
        (1, (0.0, 0.0, 0.85), False), (1, (0.0, 0.0, -0.95), True), (0, (0.0, 0.0, -1.15), False),
    ]  # fmt: skip
    actors = actors_of(van(), car(), count=5, settings=ActorSettings(box_margin=0.1))
    params = {name: value.detach()[: len(cases)].clone() for name, value in actors.params.items()}
    params["owner"] = torch.tensor([owner for owner, _, _ in cases])
    params["means"] = torch.tensor([place for _, place, _ in cases])
    params["scales"] = torch.full((len(cases), 3), -4.0)
    few = Actors(params, [van(), car()], ActorSettings(box_margin=0.1), GaussianSettings())
    before = {name: value.detach().clone() for name, value in few.named_parameters()}
    few.confine()
    after = dict(few.named_parameters())
    faded = torch.tensor([out for _, _, out in cases])
    opacities = torch.sigmoid(few.params["opacities"].detach())
    assert (opacities[faded] < min(McmcSettings().min_opacity, DefaultSettings().prune_opacity)).all()
    assert torch.equal(few.params["opacities"].detach()[~faded], before["params.opacities"][~faded])
    assert all(torch.equal(after[name], value) for name, value in before.items() if name != "params.opacities")
    assert all(value.grad is None and value.grad_fn is None for value in after.values())
    assert few.params["opacities"].requires_grad


def test_gaussians_that_spread_beyond_their_own_box_shrink():
    """The car's box is 4 x 2 x 1.6 m, grown by 0.1 m on every side: in its middle standard deviations of 1.125, 0.625
    and 0.525 m end 0.15 m beyond it. The third Gaussian is turned by 90 degrees about the vertical: its long axis is
    across the car. The last ones stand at the left side and beyond it."""
    half = 0.5**0.5
    turns = torch.tensor([[1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0], [half, 0.0, 0.0, half], *[[1.0, 0, 0, 0]] * 3])
    scales = torch.tensor(
        [[1.1, 0.6, 0.5], [0.3, 1.875, 0.3], [2.5, 0.1, 0.1], [0.1, 0.1, 0.1], [0.5, 0.25, 0.2], [0.03, 0.12, 0.03]]
    )
    params = {name: value.detach()[:6].clone() for name, value in actors_of(car(), count=6).params.items()}
    beside = torch.tensor([0.0, 0.0, 0.0, 1.0, 1.0, 1.3])
    params |= {"quats": turns, "scales": scales.log(), "means": beside[:, None] * torch.tensor([0.0, 1.0, 0.0])}
    actors = Actors(params, [car()], ActorSettings(box_margin=0.1), GaussianSettings())
    actors.confine()
    expected = scales / torch.tensor([1.0, 3.0, 4.0, 1.0, 2.0, 4.0])[:, None]
    torch.testing.assert_close(actors.params["scales"].exp().detach(), expected, rtol=0.01, atol=0.0)
    assert torch.equal(actors.params["scales"][[0, 3]], scales[[0, 3]].log()), "what fits is unchanged"
    again = actors.params["scales"].detach().clone()
    actors.confine()
    torch.testing.assert_close(actors.params["scales"].detach(), again)


@pytest.mark.parametrize(("corrected", "tolerance"), [("steadily", 1e-4), ("anyhow", 0.05)])
@pytest.mark.parametrize("time", [1.6, 2.9])
def test_rigid_groups_place_actors_as_the_model_does(time, corrected, tolerance):
    """A piece's motion goes through the corrected annotations: as the model's does where corrections change steadily,
    and within centimetres where they leap by 0.1 rad from annotation to annotation."""
    actors = actors_of(tilted(van()), car(), settings=ActorSettings(sh_degree=0))
    if corrected == "steadily":
        with torch.no_grad():
            for track, own in zip(actors.timeline.tracks, actors.timeline.owned, strict=True):
                times = torch.from_numpy(track.motion.times).float()
                actors.shared["translation"][own] = times[:, None] * torch.tensor([0.1, -0.1, 0.0])
                actors.shared["yaw"][own] = 0.15
    together, groups = sampled(actors, time), actors.rigid_groups(time)
    assert list(groups) == ["van", "car"]
    for i, piece in enumerate(groups.values()):
        (pose,) = piece.motion.poses(np.array([time]))
        own = together[actors.params["owner"] == i]
        if not piece.motion.present(np.array([time]))[0]:
            assert not own.opacities.any() and piece.gaussians.opacities.all(), "a piece is whole, present or not"
            continue
        means = piece.gaussians.means.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
        np.testing.assert_allclose(means, own.means.detach(), atol=tolerance)
        torch.testing.assert_close(piece.gaussians.scales, own.scales.detach())
        torch.testing.assert_close(piece.gaussians.opacities, own.opacities.detach())
        torch.testing.assert_close(piece.gaussians.sh, own.sh.detach())
