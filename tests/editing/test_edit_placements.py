"""Gaussians of an edited model: actors are placed where the edit moves them, and nothing else changes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import about_z
from helpers.hand_made_street import (
    AHEAD,
    GONE,
    SPEED,
    TURNING,
    straight,
    street_model,
)
from helpers.hand_made_traffic import placed
from helpers.samples import sampled_with

from drivesplat.editing.actors import editable_actors
from drivesplat.editing.placed_model import actor_placements
from drivesplat.kernels.gsplat_private import sh_basis
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.rendering.film import Shot
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Scene
from drivesplat.settings.edit import Edit, Recolour
from drivesplat.settings.render import FilmFormat, TrajectorySettings
from drivesplat.trajectories.camera_path import film_path
from drivesplat.trajectories.edited_actors import EditedActor, color_matrix, edited_actors

LAST = 4.5
"""The tiny drive's first image is at 0, its last at this second."""
TIMES = np.array([0.0, 1.3, 2.2, 3.1, LAST])
"""At the third the actor GONE is absent."""


def an_edit(*steps: dict[str, Any]) -> Edit:
    return Edit.model_validate({"steps": steps})


def edited(model: SplatModel, scene: Scene, *steps: dict[str, Any]) -> list[EditedActor]:
    return edited_actors(editable_actors(model, scene, "here"), an_edit(*steps), "here")


def edited_gaussians(
    model: SplatModel, scene: Scene, *steps: dict[str, Any], times: np.ndarray = TIMES
) -> list[Gaussians]:
    """The Gaussians at `times` after these steps."""
    placed = actor_placements(edited(model, scene, *steps), times)
    return [sampled_with(model, float(time), actors) for time, actors in zip(times, placed, strict=True)]


def rows_of(model: SplatModel, *names: str) -> torch.Tensor:
    """Which rows of the model's Gaussians belong to these actors: (n,) bool."""
    no_rows = torch.zeros(len(model), dtype=torch.bool)
    return torch.stack([no_rows, *(model.of_track(name) for name in names)]).any(dim=0)


STEPS = {
    "remove": (AHEAD,),
    "speed": (AHEAD,),
    "to": (TURNING,),
    "stop": (TURNING,),
    "reverse": (AHEAD,),
    "shift": (GONE,),
    "swap": (AHEAD, GONE),
    "duplicate": (),
    "rescale": (TURNING,),
    "recolour": (TURNING,),
    "ego": (),
}
"""Kinds of steps, and the actors that the step below changes."""
STEP = {
    "remove": {"remove": {"track": AHEAD}},
    "speed": {"speed": {"track": AHEAD, "factor": 0.5}},
    "to": {"speed": {"track": TURNING, "to": 2.0}},
    "stop": {"stop": {"track": TURNING, "at": 0.5, "duration": 1.0}},
    "reverse": {"reverse": {"track": AHEAD}},
    "shift": {"shift": {"track": GONE, "lateral": 3.0, "yaw": 20.0}},
    "swap": {"swap": {"track": AHEAD, "with": GONE}},
    "duplicate": {"duplicate": {"track": AHEAD, "as": "twin", "longitudinal": 5.0}},
    "rescale": {"rescale": {"track": TURNING, "factor": 1.5}},
    "recolour": {"recolour": {"track": TURNING, "hue": 100.0}},
    "ego": {"ego": {"lateral": 1.0}},
}


@pytest.mark.parametrize("kind", STEPS)
def test_parameters_of_unnamed_actors_do_not_change(model, scene, kind):
    before = {key: value.clone() for key, value in model.state_dict().items()}
    others = ~rows_of(model, *STEPS[kind])
    differs = False
    for time, edited in zip(TIMES, edited_gaussians(model, scene, STEP[kind]), strict=True):
        recorded = model.at(float(time))
        for name in recorded.tensors:
            now, then = (gaussians.tensors[name][: len(model)] for gaussians in (edited, recorded))
            assert torch.equal(now[others], then[others]), name
            differs |= not torch.equal(now, then)
    assert differs == bool(STEPS[kind])
    after = model.state_dict()
    assert all(torch.equal(after[key], value) for key, value in before.items()) and after.keys() == before.keys()


def view_at(scene: Scene, time: float) -> View:
    """The recorded camera's at a second of the film."""
    form = FilmFormat(camera="CAM_FRONT", fps=10, width=64, height=36, horizontal_fov=None, crf=18)
    cameras, number = film_path(scene, "CAM_FRONT", 10, TrajectorySettings()), round(10 * time)
    return next(Shot(scene, cameras[number : number + 1], form, (64, 36)).views(torch.device("cpu")))


def psnr(a: torch.Tensor, b: torch.Tensor) -> float:
    error = float((a.double() - b.double()).square().mean())
    return np.inf if error == 0.0 else -10.0 * np.log10(error)


@pytest.mark.parametrize("kind", [kind for kind in STEPS if kind != "ego"])
def test_only_pixels_reached_by_the_edited_actor_change(model, scene, kind):
    """Where its own alpha, alone, is under 1/255 at its old and at its new place."""
    changed = []
    for time, edited in zip(TIMES, edited_gaussians(model, scene, STEP[kind]), strict=True):
        view, recorded = view_at(scene, time), model.at(float(time))
        own = rows_of(model, *STEPS[kind])
        own_now = torch.cat([own, torch.ones(len(edited) - len(own), dtype=torch.bool)])
        alone = [model.render(view, gaussians=gaussians) for gaussians in (recorded[own], edited[own_now])]
        out_of_reach = (alone[0].alpha < 1 / 255) & (alone[1].alpha < 1 / 255)
        then, now = (model.render(view, gaussians=gaussians).image for gaussians in (recorded, edited))
        assert out_of_reach.sum() > 300
        assert psnr(then[out_of_reach], now[out_of_reach]) >= 90.0
        changed.append(float((then - now).abs().max()))
    assert max(changed) > 0.05


def own_gaussians(model: SplatModel, name: str, time: float) -> Gaussians:
    """An actor's in its own frame."""
    return model.rigid_groups(time)[name].gaussians


def assert_is(found: Gaussians, model: SplatModel, source: str, time: float, pose: np.ndarray, scale: float) -> None:
    """That Gaussians are those of the actor `source`, enlarged, at a pose (4, 4)."""
    own = own_gaussians(model, source, time)
    expected = placed(replace(own, means=scale * own.means, scales=scale * own.scales), pose)
    np.testing.assert_allclose(found.means, expected.means, atol=2e-4)
    np.testing.assert_allclose(found.scales, expected.scales, rtol=1e-5)
    np.testing.assert_allclose(found.opacities, expected.opacities, atol=1e-6)
    turned, wanted = (torch.nn.functional.normalize(quats, dim=-1) for quats in (found.quats, expected.quats))
    np.testing.assert_allclose((turned * wanted).sum(dim=-1).abs(), 1.0, atol=1e-5)
    np.testing.assert_allclose(found.sh[:, : expected.sh.shape[1]], expected.sh, atol=1e-4)


def left_of(pose: np.ndarray, metres: float, degrees: float = 0.0) -> np.ndarray:
    return pose @ rigid(about_z(np.radians(degrees)), np.array([0.0, metres, 0.0]))


def braked(seconds: float) -> float:
    """Seconds of its path covered by an actor that brakes from second 1 to 3: its pace falls along the quintic
    from 1 to 0 that has neither jolt nor jump, of which this is the integral."""
    x = np.clip((seconds - 1.0) / 2.0, 0.0, 1.0)
    return min(seconds, 1.0) + 2.0 * (x - (2.5 * x**4 - 3.0 * x**5 + x**6))


CLOSED_FORMS = {
    "speed": ({"speed": {"track": AHEAD, "factor": 0.5}}, lambda t: straight(0.5 * t)),
    "to": ({"speed": {"track": AHEAD, "to": 1.5}}, lambda t: straight(t * 1.5 / SPEED)),
    "stop": ({"stop": {"track": AHEAD, "at": 1.0, "duration": 2.0}}, lambda t: straight(braked(t))),
    "reverse": ({"reverse": {"track": AHEAD}}, lambda t: straight(4.535 + 0.035 - t)),
    "lateral": ({"shift": {"track": AHEAD, "lateral": -2.0}}, lambda t: left_of(straight(t), -2.0)),
    "longitudinal": ({"shift": {"track": AHEAD, "longitudinal": 9.0}}, lambda t: straight(t + 9.0 / SPEED)),
    "yaw": ({"shift": {"track": AHEAD, "yaw": 30.0}}, lambda t: left_of(straight(t), 0.0, 30.0)),
    "late": ({"shift": {"track": AHEAD, "lateral": 2.0, "start": 3.0, "duration": 0.0}},
             lambda t: left_of(straight(t), 2.0 * (t >= 3.0))),
}  # fmt: skip


@pytest.mark.parametrize(("step", "pose"), CLOSED_FORMS.values(), ids=CLOSED_FORMS)
def test_gaussians_are_placed_where_a_step_moves_their_actor(model, scene, step, pose):
    for time, edited in zip(TIMES, edited_gaussians(model, scene, step), strict=True):
        assert_is(edited[rows_of(model, AHEAD)], model, AHEAD, time, pose(time), 1.0)


def test_a_duplicate_appears_beside_its_original(model, scene):
    steps = [
        {"duplicate": {"track": AHEAD, "as": "behind", "longitudinal": -6.0, "lateral": 2.0}},
        {"duplicate": {"track": AHEAD, "as": "later", "delay": 1.0}},
        {"shift": {"track": "later", "lateral": -3.0}},
    ]
    own = rows_of(model, AHEAD)
    for time, edited in zip(TIMES, edited_gaussians(model, scene, *steps), strict=True):
        recorded, count = model.at(float(time)), int(own.sum())
        assert len(edited) == len(model) + 2 * count
        assert torch.equal(edited.means[: len(model)], recorded.means)
        assert torch.equal(edited.opacities[: len(model)], recorded.opacities)
        copies = edited[len(model) : len(model) + count], edited[len(model) + count :]
        assert_is(copies[0], model, AHEAD, time, left_of(straight(time - 1.0), 2.0), 1.0)
        assert_is(copies[1], model, AHEAD, time, left_of(straight(time - 1.0), -3.0), 1.0)


def test_a_recoloured_actor_has_other_colours_from_all_directions_and_nothing_else_changes(model, scene):
    """Its copy, recoloured again, has its own. The model's colours vary with time; here with the direction, too."""
    directed = street_model()
    with torch.no_grad():
        (actors,) = (part for part in directed.parts if part.moves)
        shn = 0.2 * torch.randn(
            len(actors), actors.params["shN"].shape[1], 3, 3, generator=torch.Generator().manual_seed(0)
        )
        actors.params["shN"] = torch.nn.Parameter(shn, requires_grad=False)
    changes = [{"track": AHEAD, "hue": 70.0, "value": 0.8}, {"track": "twin", "colour": [0.9, 0.2, 0.1]}]
    steps = [{"recolour": changes[0]}, {"duplicate": {"track": AHEAD, "as": "twin"}}, {"recolour": changes[1]}]
    first = color_matrix(Recolour(**changes[0]))
    own, toward = rows_of(directed, AHEAD).nonzero()[:, 0], torch.tensor([0.6, -0.48, 0.64])
    for time, edited in zip(TIMES, edited_gaussians(directed, scene, *steps), strict=True):
        recorded = directed.at(float(time))
        for rows, matrix in ((own, first), (slice(len(directed), None), color_matrix(Recolour(**changes[1])) @ first)):
            for field in ("means", "scales", "opacities"):
                np.testing.assert_allclose(getattr(edited, field)[rows], getattr(recorded, field)[own], atol=2e-5)
            then, now = colors_toward(recorded[own], toward), colors_toward(edited[rows], toward)
            np.testing.assert_allclose(now, then @ matrix.T, atol=1e-4)
            assert float((then - colors_toward(recorded[own], -toward)).abs().mean()) > 0.05


def colors_toward(gaussians: Gaussians, direction: torch.Tensor) -> torch.Tensor:
    """Colours (n, 3) along a direction, without the bound at 0."""
    basis = sh_basis(gaussians.sh.shape[1], direction[None].double()).float()[0]
    return 0.5 + (basis[None, :, None] * gaussians.sh).sum(dim=1)


def test_an_actor_is_absent_in_gaps_of_its_track_unless_its_pace_is_edited(model, scene):
    rows = rows_of(model, GONE)
    shifted, slow = (
        edited_gaussians(model, scene, step)
        for step in (STEP["shift"], {"speed": {"track": GONE, "to": 1.0, "start": 1.0}})
    )
    assert [bool((edited.opacities[rows] > 0).any()) for edited in shifted] == [False, True, False, True, False]
    assert [bool((edited.opacities[rows] > 0).any()) for edited in slow] == [False, True, True, True, True]
