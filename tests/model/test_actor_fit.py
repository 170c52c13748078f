"""Actors fitted to images of a known object: its shape, its colours on all sides, and what is wrong with its track.

The images are made of plain world Gaussians, placed and coloured here in closed form: no actor's code is in them.
"""

import dataclasses

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z, looking_at, motion_through, track_of
from helpers.samples import sampled

from drivesplat.model.actors import Actors
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rasterization import rasterize
from drivesplat.settings.train import GaussianSettings, TrainSettings
from drivesplat.settings.train_objects import ActorSettings, TrackSettings
from drivesplat.training.loop import Trainer
from drivesplat.training.views import TrainingView
from drivesplat.trajectories.motion import Motion

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

COUNT, SIZE = 14, np.array([2.0, 1.2, 1.0])
SPREAD, OPACITY = 0.12, 0.9
"""Standard deviation (metres) and opacity of every Gaussian."""
C0, C1 = 0.28209479, 0.48860251
"""Of the spherical harmonics of degrees 0 and 1."""
KEY_FRAMES = np.linspace(0.0, 4.0, 9)


@dataclasses.dataclass(frozen=True)
class Thing:
    """Round Gaussians at `places` (n, 3) in an object's frame; RGB `colors` (n, 3), which change by `slopes` (n, 3, 3)
    times the direction, in the object's frame, in which it is looked at."""

    places: np.ndarray
    colors: np.ndarray
    slopes: np.ndarray

    def photographed(self, pose: np.ndarray, view: View) -> torch.Tensor:
        """What a camera sees of it at a pose (4, 4): (h, w, 3)."""
        means = self.places @ pose[:3, :3].T + pose[:3, 3]
        rays = means - view.camera_to_world[:3, 3].double().numpy()
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        colors = self.colors + np.einsum("ncd,nd->nc", self.slopes, rays @ pose[:3, :3])
        count = len(means)
        return rasterize(
            torch.from_numpy(means).float(), torch.eye(4)[:1].repeat(count, 1), torch.full((count, 3), SPREAD),
            torch.full((count,), OPACITY), torch.from_numpy(colors).float(), view.viewmat[None], view.K[None],
            view.width, view.height,
        ).image[0]  # fmt: skip


def a_thing(slope: float = 0.0) -> Thing:
    rng = np.random.default_rng(0)
    places, colors = rng.uniform(-0.45, 0.45, (COUNT, 3)) * SIZE, rng.uniform(0.25, 0.75, (COUNT, 3))
    return Thing(places, colors, slope * rng.uniform(-1.0, 1.0, (COUNT, 3, 3)))


def passing_by() -> Motion:
    """Past a camera at (0.5, -5, 1.5), turning by 1.8 rad on its way."""
    places = np.stack([KEY_FRAMES - 2.0, 0.2 * np.sin(KEY_FRAMES), 0.0 * KEY_FRAMES], axis=1)
    return motion_through(KEY_FRAMES, places, 0.2 + 0.45 * KEY_FRAMES)


def recorded(thing: Thing, motion: Motion, views: list[View]) -> list[TrainingView]:
    """Images as bytes."""
    poses = motion.poses(np.array([view.time for view in views]))
    images = [thing.photographed(pose, view) for pose, view in zip(poses, views, strict=True)]
    return [TrainingView(v, (i * 255.0).round().to(torch.uint8)) for v, i in zip(views, images, strict=True)]


def from_the_kerb(count: int = 24) -> list[View]:
    """Views of a stationary camera."""
    return [looking_at([0.0, 0.0, 0.0], [0.5, -5.0, 1.5], float(time)) for time in np.linspace(0.0, 4.0, count)]


def guessed(thing: Thing, motion: Motion, settings: ActorSettings, off: float = 0.06) -> Actors:
    """Grey Gaussians, `off` metres along every axis from where they belong, in boxes as annotated."""
    rng = np.random.default_rng(1)
    places = thing.places + off * rng.normal(size=thing.places.shape)
    gaussians = GaussianSettings(init_opacity=OPACITY, lr_means=2e-3, lr_sh0=2e-2, lr_shN=2e-2)
    grey = np.full((COUNT, 3), 0.5)
    actors = Actors.from_points([track_of(motion, size=SIZE)], [places], [grey], settings, gaussians)
    with torch.no_grad():
        actors.params["scales"].fill_(np.log(SPREAD))
    return actors


def fit(actors: Actors, views: list[TrainingView], iterations: int = 200) -> None:
    """Iterations of the trainer, without densification and regularisers."""
    settings = TrainSettings(
        iterations=iterations, opacity_reg=0, scale_reg=0, entropy_weight=0, sh_every=0,
        gaussians=GaussianSettings(sh_degree=sampled(actors, 0.0).sh_degree),
    )  # fmt: skip
    trainer = Trainer.begin(SplatModel([actors], None), views, settings, 0, torch.device("cpu"))
    for _ in range(iterations):
        trainer.training_step()
        trainer.state.step += 1


def distances(actors: Actors, thing: Thing, pose: np.ndarray, time: float) -> np.ndarray:
    """How far (n,) Gaussians are in the world from where the thing has them."""
    truth = thing.places @ pose[:3, :3].T + pose[:3, 3]
    return np.linalg.norm(sampled(actors, time).means.detach().double().numpy() - truth, axis=1)


def test_an_object_is_learned_in_its_own_frame_from_images_of_it_passing_by():
    """Places from 0.08 m off to within half a centimetre of each other and colours from grey to within 1 % on the
    whole, none of them far off. The object as a whole and its track, which is right, may lean against each other by a
    centimetre or two: images cannot tell, and the track's penalty draws them back slowly. In the world it is there."""
    thing, motion = a_thing(), passing_by()
    actors = guessed(thing, motion, ActorSettings(sh_degree=0, fourier=1))
    assert np.linalg.norm(actors.params["means"].detach().numpy() - thing.places, axis=1).mean() > 0.08
    fit(actors, recorded(thing, motion, from_the_kerb()), 360)
    leaning = actors.params["means"].detach().numpy() - thing.places
    off = np.linalg.norm(leaning - leaning.mean(axis=0), axis=1)
    colors = 0.5 + C0 * actors.params["sh0"].detach().numpy()[:, 0, 0]
    assert off.mean() < 0.005 and off.max() < 0.02
    assert np.abs(colors - thing.colors).mean() < 0.01 and np.abs(colors - thing.colors).max() < 0.04
    assert np.linalg.norm(leaning.mean(axis=0)) < 0.02
    assert all(float(value.detach().abs().max()) < 0.02 for value in actors.shared.values())
    for i in (0, 4, 8):
        assert distances(actors, thing, motion.object_to_world[i], KEY_FRAMES[i]).mean() < 0.01


@pytest.mark.parametrize(("metres", "radians"), [(0.3, 0.0), (0.0, 0.25)])
def test_a_wrong_annotation_among_right_ones_is_corrected(metres: float, radians: float):
    """Less than a third of the error at its key frame is left, and nine tenths of it without corrections. Elsewhere the
    object stays where it is. Annotations are trusted little here: so few iterations hardly move them otherwise."""
    thing, motion = a_thing(), passing_by()
    poses, wrong = motion.object_to_world, motion.object_to_world.copy()
    wrong[4, :3, :3] = wrong[4, :3, :3] @ about_z(radians)
    wrong[4, 0, 3] += metres
    views, left = recorded(thing, motion, from_the_kerb()), {}
    for corrected in (True, False):
        tracks = TrackSettings(
            corrected=corrected, lr_translation=5e-3, lr_yaw=5e-3, l2_weight=1e-4, smoothness_weight=1e-4, sigma_yaw=0.3
        )
        settings = ActorSettings(sh_degree=0, fourier=1, tracks=tracks)
        actors = guessed(thing, dataclasses.replace(motion, object_to_world=wrong), settings, off=0.0)
        before = distances(actors, thing, poses[4], 2.0).mean()
        fit(actors, views, 240 if corrected else 80)
        left[corrected] = distances(actors, thing, poses[4], 2.0).mean() / before
        elsewhere = [distances(actors, thing, poses[i], KEY_FRAMES[i]).mean() for i in (0, 2, 6, 8)]
        assert max(elsewhere) < 0.06
    assert left[True] < 0.3 and left[False] > 0.9


def test_colours_learned_at_one_heading_hold_at_another():
    """From all around, while it hardly turns; then, turned by 1.8 rad, seen as nobody saw it: each side still has its
    colours. Painted for the world's directions it would show those of other sides."""
    thing = a_thing(slope=0.25)
    motion = motion_through(KEY_FRAMES, np.zeros((9, 3)), 0.45 * KEY_FRAMES)
    tracks = TrackSettings(corrected=False)
    actors = guessed(thing, motion, ActorSettings(sh_degree=1, fourier=1, tracks=tracks), off=0.0)
    around = [
        about_z(angle) @ [5.0, 0.0, 1.0 + np.sin(3.0 * angle)] for angle in np.linspace(0.0, 2.0 * np.pi, 17)[:-1]
    ]
    fit(actors, recorded(thing, motion, [looking_at([0.0, 0.0, 0.0], p, 0.02 * i) for i, p in enumerate(around)]))
    view = looking_at([0.0, 0.0, 0.0], [3.0, -4.0, 1.2], 4.0)
    (pose,) = motion.poses(np.array([4.0]))
    truth = thing.photographed(pose, view)
    with torch.no_grad():
        seen = SplatModel([actors], None).render(view).image
    painted = dataclasses.replace(thing, slopes=thing.slopes @ pose[:3, :3])
    wrong = painted.photographed(pose, view)
    assert float((wrong - truth).square().mean()) > 100.0 * float((seen - truth).square().mean())
    assert float((seen - truth).abs().max()) < 0.05
