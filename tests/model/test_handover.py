"""What a block takes over from the block before: static Gaussians by place, objects, the road, and exposures."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.hand_made import actors_of, motion_through, round_gaussians, track_of
from helpers.samples import sampled

from drivesplat.model.background import Background
from drivesplat.model.deformable import Deformable
from drivesplat.model.exposure import Exposures
from drivesplat.model.handover import Handover, joined, same_track
from drivesplat.model.height_field import HeightField
from drivesplat.model.road import EDGE, RoadPart, RoadSeed
from drivesplat.settings.train import ExposureSettings, GaussianSettings
from drivesplat.settings.train_objects import ActorSettings, DeformableSettings

SHIFT, SECONDS = np.array([-40.0, 3.0, 0.0]), -4.0
"""From the block before to this one, whose world begins 40 m farther along the path, and whose time 4 s later."""
ALONG = np.stack([np.arange(-40.0, 71.0), np.zeros(111)], axis=1)
HANDOVER = Handover(SHIFT, SECONDS, ALONG[:71], ALONG[20:], cap_max=100)
"""The block before was driven from x = -40 to 30 m of this world, this one is from -20 m on."""
DRIVEN = 0.5 * np.arange(9)


def moving(first: int, end: int, name: str = "van", aside: float = 0.0):
    """A track in the world and the time of this block, with the annotations `first` to `end`."""
    times = DRIVEN[first:end]
    return track_of(motion_through(times, [[5.0 * t, 2.0 + aside, 0.5] for t in times], 0.1 * times), name)


def there(track):
    """The same track in the world and the time of the block before."""
    motion = track.motion
    poses = motion.object_to_world.copy()
    poses[:, :3, 3] -= SHIFT
    return replace(track, motion=replace(motion, times=motion.times - SECONDS, object_to_world=poses))


def test_static_gaussians_are_taken_where_this_block_is_driven():
    """Those beside the path before alone, and those that nobody sees, are not."""
    places = np.array([[-30.0, 4, 1], [-19.0, 4, 1], [10.0, -6, 2], [90.0, 0, 8], [12.0, 0, 0]])
    before = round_gaussians(places - SHIFT, opacities=[0.9, 0.9, 0.9, 0.9, 1e-4])
    seeds = np.random.default_rng(0).uniform([0, 20, 0], [1, 21, 1], (8, 3))
    own = Background.from_points(seeds, seeds % 1, GaussianSettings(sh_degree=0), 10.0)
    before.params["shN"] = torch.nn.Parameter(torch.zeros(5, 0, 3))
    own.take_over(before, HANDOVER)
    learned = own.params["means"].detach().numpy()[:3]
    np.testing.assert_allclose(learned, places[1:4], atol=1e-4)
    assert len(own) == 3 + 8
    assert torch.equal(own.params["opacities"][:3], before.params["opacities"][1:4])


def test_no_place_has_a_seed_and_a_learned_gaussian():
    seeds = {"means": torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [50.0, 0, 0]]), "row": torch.arange(3)}
    learned = {"means": torch.tensor([[0.3, 0, 0], [57.0, 0, 0]]), "row": torch.tensor([10, 11])}
    spacing = np.array([0.5, 0.5, 10.0])
    assert joined(seeds, learned, spacing, 9)["row"].tolist() == [10, 11, 1], "sparse seeds are far from each other"
    assert joined(seeds, learned, np.zeros(3), 9)["row"].tolist() == [10, 11, 0, 1, 2]
    fewer = joined(seeds, learned, np.zeros(3), 3)["row"].tolist()
    assert len(fewer) == 3 and {*fewer} < {10, 11, 0, 1, 2}
    nothing = {name: values[:0] for name, values in learned.items()}
    assert joined(seeds, nothing, spacing, 9)["row"].tolist() == [0, 1, 2]


def test_a_part_with_other_parameters_starts_from_its_seed():
    places = np.random.default_rng(0).uniform(0, 9, (6, 3))
    before = Background.from_points(places, places / 9, GaussianSettings(sh_degree=0), 9.0)
    own = Background.from_points(places, places / 9, GaussianSettings(sh_degree=1), 9.0)
    own.take_over(before, HANDOVER)
    assert len(own) == 6 and own.params["shN"].shape[1] == 3


def road(color: float, x: float) -> RoadPart:
    """Flat, from x to x + 20 m, with a Gaussian every metre."""
    xs, ys = np.meshgrid(np.arange(x + 0.5, x + 20), np.arange(-2.5, 3.0))
    positions = np.stack([xs.ravel(), ys.ravel(), np.zeros(xs.size)], axis=1)
    surface = HeightField(torch.tensor([x, -3.0]), EDGE, torch.zeros(41, 13), torch.ones(40, 12, dtype=torch.bool))
    seed = RoadSeed(surface, positions, np.full(len(positions), 1.0), np.full((len(positions), 3), color))
    return RoadPart.from_seed(seed, GaussianSettings(sh_degree=0), 10.0)


def test_a_road_goes_on_and_keeps_its_number_of_gaussians():
    before, own = road(0.2, 20.0), road(0.8, -10.0)  # from -20 to 0 m and from -10 to 10 m of this world
    handover = replace(HANDOVER, shift=np.array([-40.0, 0.0, 0.0]))
    own.take_over(before, handover)
    found, dark = own.params["means"].detach(), own.params["sh0"].detach()[:, 0, 0] < 0
    assert len(own) == own.cap_max == 120
    assert (found[dark, 0] < 0).all() and (found[~dark, 0] > 0).all() and dark.sum() == 60


@pytest.mark.parametrize("kind", ["rigid", "deforms"])
def test_objects_of_both_blocks_look_as_in_the_block_before(kind):
    van, early, late = moving(0, 5), moving(0, 3, "early"), moving(2, 9, "late")
    settings = ActorSettings() if kind == "rigid" else DeformableSettings()
    before, own = actors_of(there(early), there(van), settings=settings), None
    if kind == "deforms":
        before = deforming(before, settings)
    own = actors_of(moving(3, 9), late, settings=settings, seed=1, count=9, shaken=False)
    own = own if kind == "rigid" else deforming(own, settings)
    own.take_over(before, HANDOVER)
    assert own.params["owner"].tolist() == [1] * 9 + [0] * 6
    at = float(DRIVEN[4])  # the last annotation that both have
    shown, expected = sampled(own, at), sampled(before, at - SECONDS)
    van_before, van_here = before.of_track("van"), own.of_track("van")
    torch.testing.assert_close(
        shown.means[van_here], expected.means[van_before] + torch.tensor(SHIFT).float(), atol=2e-3, rtol=0.0
    )
    torch.testing.assert_close(shown.sh[van_here], expected.sh[van_before], atol=2e-3, rtol=0.0)
    assert float(shown.opacities[van_here].detach().min()) > 0.0


def deforming(actors, settings: DeformableSettings) -> Deformable:
    params = {name: values.detach() for name, values in actors.params.items()}
    part = Deformable(params, actors.timeline.tracks, settings, GaussianSettings())
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, value in actors.shared.items():
            part.shared[name].copy_(value)
        if len(actors.ids) and actors.ids[0] == "early":
            part.shared["lattice"] += 0.1 * torch.randn(part.shared["lattice"].shape, generator=generator)
            part.shared["stride"] += 0.2
    return part


def test_the_number_of_gaussians_of_objects_may_stay_as_it_was():
    before = actors_of(there(moving(0, 5)), count=30)
    own = actors_of(moving(3, 9), count=5, settings=ActorSettings(cap_max=20), shaken=False)
    own.take_over(before, HANDOVER)
    assert len(own) == own.cap_max == 30


def test_an_object_of_the_same_name_elsewhere_is_another_one():
    van = moving(0, 5)
    assert same_track(there(van).motion, moving(3, 9).motion, HANDOVER) == [(3, 0), (4, 1)]
    assert same_track(there(van).motion, moving(3, 9, aside=1.0).motion, HANDOVER) == []
    assert same_track(there(van).motion, moving(6, 9).motion, HANDOVER) == []
    own = actors_of(moving(3, 9, aside=1.0), seed=1)
    seeds = own.params["means"].detach().clone()
    own.take_over(actors_of(there(van)), HANDOVER)
    assert torch.equal(own.params["means"], seeds)


@pytest.mark.parametrize("known_before", [True, False])
@pytest.mark.parametrize("known_here", [True, False])
def test_the_gain_curve_of_an_exposure_goes_on_where_that_of_the_block_before_ends(known_before, known_here):
    """Each is of mean 0 over the images of its own block."""
    settings, fall = ExposureSettings(interval=1.0), torch.tensor([0.5, 0.5, 0.5, 0.5, -0.5, -0.5, -0.5, -0.5])
    earlier = {"front": fall[:, None].expand(8, 3)} if known_before else {}
    later = {"front": torch.tensor([0.3, 0.3, 0.3, 0.3, -0.6, -0.6])[:, None].expand(6, 3)} if known_here else {}
    before = Exposures({}, settings, ("front",), torch.arange(8.0), earlier)
    own = Exposures({}, settings, ("front",), torch.arange(6.0), later)
    own.take_over(before, SECONDS)
    if not known_before and not known_here:
        assert not own.curve.keys()
        return
    gains = own.curve["front"][:, 0]
    torch.testing.assert_close(gains[:4].mean(), torch.tensor(-0.5 if known_before else 0.0))
    torch.testing.assert_close(gains[4] - gains[0], torch.tensor(-0.9 if known_here else 0.0))


def test_exposures_go_on_over_time():
    settings = ExposureSettings(interval=1.0)
    before = Exposures({"left": torch.full((3,), 1.2)}, settings, ("front",), torch.arange(8.0))
    own = Exposures({"left": torch.ones(3)}, settings, ("front",), torch.arange(6.0))
    with torch.no_grad():
        for values in before.params.values():
            values += torch.randn(values.shape, generator=torch.Generator().manual_seed(0))
    own.take_over(before, SECONDS)
    torch.testing.assert_close(own.params["front"][:4], before.params["front"][4:])
    torch.testing.assert_close(own.params["front"][4:], before.params["front"][-1:].expand(2, 3))
    torch.testing.assert_close(own.params["left"][:2], before.params["left"][:2])
    assert own.first["left"].tolist() == before.first["left"].tolist()
