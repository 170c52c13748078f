"""Cameras, Gaussians from seed points, composition over a sky, and a model saved and rebuilt."""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made import actor_record, actors_of, looking_at, motion_through, round_gaussians, track_of
from helpers.records import training_record_of
from helpers.reference_rays import pixel_rays
from helpers.samples import EVERYTHING, sampled
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.errors import ResultError
from drivesplat.io.storage import no_provenance
from drivesplat.model import splat_model
from drivesplat.model.actors import Actors
from drivesplat.model.background import Background
from drivesplat.model.build import ModelInit, actor_cap, build_model, gaussian_cap
from drivesplat.model.checkpoint import TrainedCheckpoint, read_checkpoint, trained_model, write_checkpoint
from drivesplat.model.gaussians import concatenate
from drivesplat.model.sky import ConstantSky, CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import copied, tensors_of
from drivesplat.model.timeline import ActorTrack
from drivesplat.model.view import View
from drivesplat.rasterization import rasterize
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.drifting import DriftingSettings
from drivesplat.settings.train import GaussianSettings, TrainJob, TrainSettings
from drivesplat.settings.train_objects import ActorSettings
from drivesplat.trajectories.actor_record import ActorRecord

pytestmark = pytest.mark.usefixtures("one_thread")
SH_C0 = 0.5 / np.sqrt(np.pi)
STREET = ("background", "actors", "drifting")
SKY_COLOR = np.array([0.2, 0.4, 0.8])


def a_view(width: int = 24, height: int = 16) -> View:
    """A camera turned and moved, with its principal point off the middle."""
    camera_to_world = torch.eye(4)
    camera_to_world[:3, :3] = torch.from_numpy(Rotation.from_euler("xyz", [0.1, -0.2, 0.05]).as_matrix())
    camera_to_world[:3, 3] = torch.tensor([0.4, -0.3, -1.0])
    intrinsics = torch.tensor([[20.0, 0.0, 11.3], [0.0, 22.0, 8.9], [0.0, 0.0, 1.0]])
    return View(intrinsics, camera_to_world, width, height, time=0.5)


def seed_points(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Positions before the camera of `a_view`, and colours in [0, 1]."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-2, -1.5, 2], [2, 1.5, 6], (count, 3)), rng.uniform(0, 1, (count, 3))


def parser_record(count: int) -> TrainingRecord:
    positions, colors = seed_points(count)
    return training_record_of(
        3,
        points=positions.astype(np.float32),
        points_rgb=(colors * 255).astype(np.uint8),
        scene_scale=3.0,
        image_sizes=np.array([[100, 50], [100, 50], [40, 30]]),
        splits={"train": np.array([0, 2]), "interpolation": np.array([1])},
    )


def model_init(record: TrainingRecord, *actors: ActorRecord) -> ModelInit:
    return ModelInit(record, list(actors), SKY_COLOR)


def shaken(model: nn.Module) -> nn.Module:
    """The model with every learned parameter moved, as after a training."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for value in (value for value in model.parameters() if value.requires_grad):
            value += 0.2 * torch.randn(value.shape, generator=generator)
    return model


def test_rays_of_a_view_are_those_of_its_pixels():
    view = a_view()
    expected = pixel_rays((view.width, view.height), view.K.double().numpy(), view.camera_to_world.double().numpy())
    np.testing.assert_allclose(view.rays().numpy(), expected, atol=1e-6)
    torch.testing.assert_close(view.viewmat @ view.camera_to_world, torch.eye(4), atol=1e-6, rtol=0)


def test_a_gaussian_shows_where_its_ray_points():
    """Rays and rasterizer share one pixel convention."""
    view = a_view()
    row, column = 5, 17
    at = view.camera_to_world[:3, 3] + 4.0 * view.rays()[row, column]
    params = Background.from_points(
        at[None].numpy(), np.ones((1, 3)), GaussianSettings(sh_degree=0, init_opacity=0.5), 1.0
    ).params
    params["scales"].data.fill_(np.log(0.02))
    alpha = SplatModel([Background(dict(params), GaussianSettings(), 1.0)], None).render(view, 0).alpha.detach()
    assert torch.equal((alpha == alpha.max()).nonzero(), torch.tensor([[row, column]]))
    assert float(alpha.max()) == pytest.approx(0.5, abs=1e-4)


def test_seed_gaussians_are_those_of_the_points():
    """Their positions and colours; the opacity set; isotropic, with the distance of neighbours as scale."""
    positions, colors = seed_points(60)
    settings = GaussianSettings(sh_degree=2, init_opacity=0.3, init_scale=0.4, lr_means=1e-4)
    part = Background.from_points(positions, colors, settings, 7.0)
    gaussians = sampled(part, 0.0)
    np.testing.assert_allclose(gaussians.means.detach(), positions, atol=1e-6)
    np.testing.assert_allclose(0.5 + SH_C0 * gaussians.sh[:, 0].detach(), colors, atol=1e-6)
    assert gaussians.sh.shape == (60, 9, 3) and (gaussians.sh[:, 1:] == 0).all()
    torch.testing.assert_close(gaussians.opacities.detach(), torch.full((60,), 0.3))
    distances = np.sort(np.linalg.norm(positions[:, None] - positions[None], axis=-1), axis=1)[:, 1:4]
    expected = 0.4 * np.sqrt((distances**2).mean(axis=1))
    np.testing.assert_allclose(gaussians.scales.detach(), expected[:, None].repeat(3, axis=1), rtol=1e-5)
    np.testing.assert_array_equal(gaussians.quats.detach(), np.tile([1.0, 0.0, 0.0, 0.0], (60, 1)))
    assert part.learning_rates()["means"] == pytest.approx(7e-4), "in proportion to the scene"
    assert part.learning_rates().keys() >= set(part.params)


@pytest.mark.parametrize("positions", [*(np.arange(3.0 * n).reshape(n, 3) for n in (1, 2, 4)), np.ones((5, 3))])
def test_few_or_coincident_points_give_gaussians(positions):
    colors = np.full_like(positions, 0.5)
    gaussians = sampled(Background.from_points(positions, colors, GaussianSettings(), 1.0), 0.0)
    assert len(gaussians) == len(positions)
    assert torch.isfinite(gaussians.scales.log()).all()


@pytest.mark.parametrize("sky", [ConstantSky, CubemapSky])
def test_the_sky_is_composited_behind_the_gaussians(sky):
    part = Background.from_points(*seed_points(40), GaussianSettings(init_scale=0.3, init_opacity=0.5), 1.0)
    color = torch.tensor([0.3, 0.6, 0.9])
    behind = sky(color, 1e-2) if sky is ConstantSky else shaken(sky(4, color, 1e-2))
    view = a_view()
    with torch.no_grad():
        without = SplatModel([part], None).render(view, 0)
        picture = SplatModel([part], behind).render(view, 0, with_depth=True)
    assert float(without.alpha.max()) > 0.5 and float(without.alpha.min()) < 0.1
    expected = without.image + (1.0 - without.alpha)[..., None] * behind.colors(view.rays())
    torch.testing.assert_close(picture.image, expected)
    torch.testing.assert_close(picture.alpha, without.alpha)
    assert picture.depth.shape == picture.alpha.shape and without.depth is None


def test_concatenate_keeps_order_and_every_field():
    parts = (Background.from_points(*seed_points(n, seed=n), GaussianSettings(sh_degree=1), 1.0) for n in (3, 4))
    a, b = (sampled(part, 0.0) for part in parts)
    joined = concatenate([a, b])
    assert len(joined) == 7
    assert joined.velocities is None
    for name, values in joined.tensors.items():
        torch.testing.assert_close(values[:3], a.tensors[name])
        torch.testing.assert_close(values[3:], b.tensors[name])
    moving = concatenate([a, dataclasses.replace(b, velocities=torch.ones(4, 3))])
    assert moving.velocities.tolist() == [[0.0] * 3] * 3 + [[1.0] * 3] * 4
    assert moving[torch.tensor([5])].velocities.tolist() == [[1.0] * 3]
    assert concatenate([a]) is a


@pytest.mark.parametrize("degrees", [(0, 2), (3, 1)])
def test_concatenation_keeps_the_colours_of_lower_degrees(degrees):
    parts = [
        shaken(Background.from_points(*seed_points(n, seed=n), GaussianSettings(sh_degree=degree), 1.0))
        for n, degree in zip((3, 4), degrees, strict=True)
    ]
    joined = concatenate([sampled(part, 0.0) for part in parts])
    assert joined.sh_degree == max(degrees)
    directions = Rotation.random(2, random_state=0).as_matrix()[:, 0]
    for part, rows in zip(parts, (slice(0, 3), slice(3, 7)), strict=True):
        alone = sampled(part, 0.0).sh
        assert torch.equal(joined.sh[rows, : alone.shape[1]], alone) and not joined.sh[rows, alone.shape[1] :].any()
    for view in (looking_at([0.0, 0.0, 4.0], [0.0, 0.0, 4.0] + 9.0 * d) for d in directions):
        alone = SplatModel([parts[1]], None).render(view).image
        model = SplatModel(parts, None)
        seen = model.render(view, gaussians=model.at(0.0)[3:]).image
        torch.testing.assert_close(seen, alone)


def a_track(name: str = "it", start: float = 0.0) -> ActorTrack:
    """Half a second a box, from 3 m before the camera of `a_view` on."""
    times = start + 0.5 * np.arange(4)
    return track_of(motion_through(times, [[0.5 * i, -0.2, 3.0 + i] for i in range(4)], 0.4 * times), name)


def street(antialiased: bool = False) -> SplatModel:
    """Background, two actors, of which the second comes at 1 second, and more background."""
    first, second = (Background.from_points(*seed_points(n), GaussianSettings(), 1.0) for n in (12, 5))
    return SplatModel([first, actors_of(a_track(), a_track("later", 1.0), count=4), second], None, antialiased)


def test_rows_are_the_slices_of_each_part():
    model = street()
    together = model.at(0.7)
    assert model.rows == [slice(0, 12), slice(12, 20), slice(20, 25)]
    for part, rows in zip(model.parts, model.rows, strict=True):
        assert torch.equal(together[rows].means, sampled(part, 0.7).means)
    assert len(model) == 25 and model.moving().tolist() == [False] * 12 + [True] * 8 + [False] * 5
    assert model.of_track("later").tolist() == [False] * 16 + [True] * 4 + [False] * 5
    assert model.of_track("another") is None
    images = [model.render(dataclasses.replace(a_view(), time=time)).image for time in (0.7, 1.6)]
    given = model.render(a_view(), gaussians=together).image
    assert torch.equal(images[0], given) and not torch.equal(images[1], given), "at the time of the view"


def test_gaussians_follow_the_states_copied_into_the_tensors():
    model = street()
    early, late = (model.states(time) for time in (0.3, 1.6))
    lying = copied(early)
    for time, states in ((0.3, early), (1.6, late)):
        for place, values in zip(tensors_of(lying), tensors_of(states), strict=True):
            place.copy_(values)
        found, expected = concatenate(model.sample(lying)), model.at(time)
        assert all(torch.equal(values, expected.tensors[name]) for name, values in found.tensors.items())
    assert not torch.equal(model.at(0.3).means, model.at(1.6).means)


def test_two_rigid_groups_of_one_name_are_refused():
    """Two parts of one name, and a track that is called like a part."""
    still = Background.from_points(*seed_points(3), GaussianSettings(), 1.0)
    for other in (still, actors_of(a_track("it"), a_track("background"))):
        with pytest.raises(ResultError, match=r"'background'.*train it again"):
            SplatModel([still, other], None).rigid_groups(0.0)
    assert list(SplatModel([still, actors_of(a_track("it"))], None).rigid_groups(0.0)) == ["background", "it"]


@pytest.mark.parametrize("antialiased", [False, True])
def test_the_alpha_of_dynamic_parts_equals_their_own_rendering(antialiased):
    """Whatever stands before or behind it in the picture."""
    model = street(antialiased)
    model.parts[1].params["scales"].data -= 2.0  # small enough for antialiasing to matter
    picture = model.render(a_view())
    found = model.objects_alpha(picture, a_view())
    alone = SplatModel([model.parts[1]], None, antialiased).render(a_view()).alpha
    torch.testing.assert_close(found, alone)
    assert float(found.detach().max()) > 0.05 and float((picture.alpha - found).detach().abs().max()) > 0.1


def test_the_alpha_of_dynamic_parts_is_asked_for_beside_the_image_where_they_are_neighbours(monkeypatch):
    """And rendered by itself where it is not among what the image comes with."""
    asked = []

    def rasterized(*arguments, objects=None, **options):
        asked.append(objects)
        rendering = rasterize(*arguments, **options)
        return dataclasses.replace(rendering, objects_alpha=0.5 * rendering.alpha) if objects else rendering

    monkeypatch.setattr(splat_model, "rasterize", rasterized)
    still, moves = Background.from_points(*seed_points(12), GaussianSettings(), 1.0), actors_of(a_track(), count=4)
    others = actors_of(a_track("later", 1.0), count=3)
    for parts, rows in (
        ([still, moves], slice(12, 16)), ([moves, others, still], slice(0, 7)), ([moves, still, others], None),
        ([still], None),
    ):  # fmt: skip
        model = SplatModel(parts, None)
        picture = model.render(a_view(), with_objects=True)
        assert asked[-1] == rows
        if rows is None:
            assert picture.objects_alpha is None
            assert (model.objects_alpha(picture, a_view()) is None) == (len(parts) == 1), "nothing moves"
        else:
            assert torch.equal(model.objects_alpha(picture, a_view()), 0.5 * picture.alpha)
    model.render(a_view())
    assert asked[-1] is None


@pytest.mark.parametrize(
    ("sky", "logits", "changes"),
    [("none", (0.3, 0.9), {"antialiased": True}), ("mask", None, {"max_scale": 0.05}), ("cubemap", None, {})],
)
def test_a_street_saved_and_rebuilt_is_the_same_to_the_bit(sky, logits, changes, tmp_path):
    """Places, colours and presence at many times; pictures, learning rates and penalties, too. Of a training, in whose
    course Gaussians came and went."""
    actors, drifting = ActorSettings(sh_degree=2, fourier=3, cap_max=50), DriftingSettings(min_span=0.7)
    settings = TrainSettings(sky_resolution=4, actors=actors, drifting=drifting, **changes)
    records, parts = [actor_record(a_track(), 10), actor_record(a_track("later", 1.0), 7)], STREET
    init = ModelInit(parser_record(20), records, SKY_COLOR, lidar_logits=logits)
    model = shaken(build_model(init, parts, sky, settings))
    for value in model.parts[1].params.values():
        value.data = value.data[3:]
    job = TrainJob(parts=parts, sky=sky, train=settings, random_seed=0)
    write_checkpoint(tmp_path / "a.npz", TrainedCheckpoint.of(model, job, no_provenance()))
    rebuilt = trained_model(read_checkpoint(tmp_path / "a.npz"))
    assert [part.name for part in rebuilt.parts] == list(parts)
    assert rebuilt.moving().sum() == 14 + len(model.parts[2]) > 14
    for time in (-0.2, 0.61, 1.8, 5.0):
        ours, again = (it.at(time, EVERYTHING).tensors for it in (model, rebuilt))
        assert ours.keys() == again.keys() and ("lidar_logits" in ours) == (logits is not None)
        assert all(torch.equal(values, again[name]) for name, values in ours.items())
    picture, again = (it.render(a_view(), with_depth=True) for it in (model, rebuilt))
    assert torch.equal(again.image, picture.image) and torch.equal(again.depth, picture.depth)
    assert (rebuilt.antialiased, rebuilt.max_scale) == (settings.antialiased, settings.max_scale)
    for part, again in zip(model.parts, rebuilt.parts, strict=True):
        assert again.definition() == part.definition() if part.name == "drifting" else again.extent == part.extent
        assert again.learning_rates() == part.learning_rates() and again.penalties().keys() == part.penalties().keys()
        assert all(torch.equal(value, part.penalties()[name]) for name, value in again.penalties().items())
    assert [value.requires_grad for value in rebuilt.parameters()] == [v.requires_grad for v in model.parameters()]


def test_actors_are_initialised_from_their_records():
    records = [actor_record(a_track(), 10, seed=1), actor_record(a_track("later", 1.0), 7, seed=2)]
    model = build_model(model_init(parser_record(20), *records), ("background", "actors"), "none", TrainSettings())
    actors = model.parts[1]
    assert actors.params["owner"].tolist() == [0] * 10 + [1] * 7
    np.testing.assert_array_equal(actors.params["means"].detach(), np.concatenate([r.points for r in records]))
    colors = np.concatenate([r.points_rgb for r in records]) / 255.0
    for time in (0.3, 1.3):
        np.testing.assert_allclose(0.5 + SH_C0 * sampled(actors, time).sh0[:, 0].detach(), colors, atol=1e-5)
        assert not sampled(actors, time).sh[:, 1:].any()
    at = np.linspace(-0.5, 3.0, 15)
    for track, expected in zip(actors.timeline.tracks, (a_track(), a_track("later", 1.0)), strict=True):
        assert track.id == expected.id
        np.testing.assert_array_equal(track.motion.poses(at), expected.motion.poses(at))
        np.testing.assert_array_equal(track.motion.present(at), expected.motion.present(at))


@pytest.mark.parametrize(
    ("pixels", "changes", "expected"),
    [
        pytest.param(1000, {}, 50, id="the pixels in its box decide: 1000 / 20"),
        pytest.param(100, {}, 8, id="never less than the least"),
        pytest.param(1000, {"pixels_per_gaussian": 0.0}, 300, id="no limit by pixels"),
    ],
)
def test_an_actors_gaussians_are_capped_by_its_training_pixels(pixels, changes, expected):
    settings = TrainSettings(
        **{"pixels_per_gaussian": 20.0, "actors": ActorSettings(min_gaussians=8, cap_max=300), **changes}
    )
    record = actor_record(a_track(), pixels=pixels)
    assert actor_cap(record, settings.actors, settings.pixels_per_gaussian) == expected


def test_each_actor_is_initialised_with_at_most_its_cap():
    """A twentieth of 400 and of 2000 pixels; together they may never have more than both."""
    records = [actor_record(a_track(), 60, pixels=400), actor_record(a_track("later", 1.0), 60, pixels=2000)]
    settings = TrainSettings(pixels_per_gaussian=20.0, actors=ActorSettings(min_gaussians=8))
    (actors,) = build_model(model_init(parser_record(20), *records), ("actors",), "none", settings).parts
    assert actors.params["owner"].tolist() == [0] * 20 + [1] * 60 and actors.cap_max == 120
    kept = {tuple(row) for row in actors.params["means"].detach()[:20].numpy()}
    assert len(kept & {tuple(row) for row in records[0].points}) == 20
    colors = dict(zip(map(tuple, records[0].points), records[0].points_rgb, strict=True))
    own = 255.0 * (0.5 + SH_C0 * sampled(actors, 0.0).sh0[:20, 0].detach().numpy())
    means = actors.params["means"].detach()[:20].numpy()
    np.testing.assert_allclose(own, [colors[tuple(row)] for row in means], atol=0.01)


def with_cap(cap_max: int, counts: list[int]) -> Actors:
    """The actors of a model whose seeds have so many points each."""
    records = [actor_record(a_track(str(i)), count, seed=i, pixels=100_000) for i, count in enumerate(counts)]
    settings = TrainSettings(actors=ActorSettings(cap_max=cap_max))
    return build_model(model_init(parser_record(20), *records), ("background", "actors"), "none", settings).parts[1]


@pytest.mark.parametrize(
    ("cap_max", "counts", "expected"),
    [
        pytest.param(400, [100] * 4, [100] * 4, id="no more than the cap: all"),
        pytest.param(40, [100] * 4, [10] * 4, id="equals share alike"),
        pytest.param(68, [104, 204, 404], [4 + 8, 4 + 16, 4 + 32], id="four each, and 56 of 700 beyond them"),
        pytest.param(20, [2, 3, 100], [2, 3, 15], id="who has fewer than four keeps them"),
        pytest.param(1, [100, 3, 100], [4, 3, 4], id="four each where the cap has no room for them"),
    ],
)
def test_actors_share_a_cap_in_proportion_to_their_seeds(cap_max, counts, expected):
    actors = with_cap(cap_max, counts)
    assert torch.bincount(actors.params["owner"], minlength=len(counts)).tolist() == expected
    assert actors.cap_max == cap_max


def test_seeds_are_thinned_to_a_reproducible_subset():
    """A cap that divides unevenly is used up fairly."""
    actors, again = (with_cap(50, [100] * 4) for _ in range(2))
    assert torch.equal(actors.params["means"], again.params["means"])
    counts = []
    for i in range(4):
        own = actors.params["means"].detach()[actors.params["owner"] == i].numpy()
        points = {tuple(row) for row in actor_record(a_track(), 100, seed=i).points}
        counts.append(len({tuple(row) for row in own} & points))
    assert sorted(counts) == [12, 12, 13, 13]


def test_the_part_actors_takes_the_records_of_its_own_objects():
    """Without any that have points a street is its background."""
    record = actor_record(track_of(motion_through(np.array([0.0, 1.0]), np.zeros((2, 3))), "a"))
    others = dataclasses.replace(record, id="b", parts=("another",))
    assert [part.name for part in street_of(record, others).parts] == ["background", "actors"]
    assert street_of(record, others).parts[1].definition().tracks[0].id == "a"
    no_points = actor_record(track_of(motion_through([0.0], [[0.0, 0.0, 0.0]])), 0)
    for records in ([], [others], [no_points]):
        model = street_of(*records)
        assert [part.name for part in model.parts] == ["background"] and not model.moving().any()


def street_of(*records: ActorRecord) -> SplatModel:
    return build_model(model_init(parser_record(20), *records), ("background", "actors"), "none", TrainSettings())


@pytest.mark.parametrize(("sky", "kind"), [("none", type(None)), ("mask", ConstantSky), ("cubemap", CubemapSky)])
def test_the_sky_setting_selects_the_sky(sky, kind):
    model = build_model(model_init(parser_record(5)), ("background",), sky, TrainSettings(sky_resolution=4))
    assert isinstance(model.sky, kind)
    if model.sky is not None:
        np.testing.assert_allclose(model.sky.colors(a_view().rays())[3, 4].detach(), SKY_COLOR, atol=1e-5)


def test_a_model_is_initialised_with_at_most_its_cap():
    record = parser_record(300)
    model = build_model(model_init(record), ("background",), "none", TrainSettings(cap_max=120))
    means = model.parts[0].params["means"].detach().numpy()
    assert len(model) == 120
    rows = {tuple(row) for row in record.points}
    assert len({tuple(row) for row in means} & rows) == 120


@pytest.mark.parametrize(
    ("cap_max", "pixels_per_gaussian", "expected"),
    [
        pytest.param(1000, 20.0, 310, id="the training pixels decide: (100 x 50 + 40 x 30) / 20"),
        pytest.param(200, 20.0, 200, id="cap_max decides"),
        pytest.param(1000, 0.0, 1000, id="no limit by pixels"),
        pytest.param(1000, 1e6, 1, id="never less than one"),
    ],
)
def test_gaussians_are_capped_by_the_training_pixels(cap_max, pixels_per_gaussian, expected):
    settings = TrainSettings(cap_max=cap_max, pixels_per_gaussian=pixels_per_gaussian)
    assert gaussian_cap(parser_record(5), settings) == expected


def test_with_a_limit_a_large_gaussian_is_shown_as_a_smaller_one_and_others_stay():
    """Three Gaussians of 2 m, 5, 20 and 103 m away: with 0.1 the first is limited to 0.5 m."""
    places = [[5.0, 0.0, 0.0], [20.0, 4.0, 0.0], [100.0, -25.0, 0.0]]
    view = looking_at([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])
    full = SplatModel([round_gaussians(places, [2.0, 2.0, 2.0])], None)
    limited = SplatModel([round_gaussians(places, [2.0, 2.0, 2.0])], None, max_scale=0.1)
    smaller = SplatModel([round_gaussians(places, [0.5, 2.0, 2.0])], None)
    with torch.no_grad():
        shown, expected = (model.render(view, with_surface_depth=True) for model in (limited, smaller))
        assert float((full.render(view).alpha - shown.alpha).max()) > 0.3
    torch.testing.assert_close(shown.alpha, expected.alpha)
    torch.testing.assert_close(shown.surface_depth, expected.surface_depth)
    assert torch.equal(shown.shapes.scales, limited.gaussians_in(view).scales), "the model itself stays as it is"


def test_a_limited_gaussian_has_a_gradient_for_its_colour_and_none_for_its_size():
    model = SplatModel([round_gaussians([[5.0, 0.0, 0.0], [20.0, 4.0, 0.0]], [2.0, 1.0])], None, max_scale=0.1)
    model.render(looking_at([1.0, 0.0, 0.0], [0.0, 0.0, 0.0])).image.sum().backward()
    scales, colors = (model.parts[0].params[name].grad for name in ("scales", "sh0"))
    assert float(scales[0].abs().max()) == 0.0 and float(scales[1].abs().max()) > 0.0
    assert float(colors[0].abs().max()) > 0.0
