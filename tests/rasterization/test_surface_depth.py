"""The depth of surfaces of known depth; test_closed_forms.py compares it with a naive compositing."""

import math
from dataclasses import fields, replace

import numpy as np
import torch
from helpers.random_gaussians import Scene, random_scene
from scipy.spatial.transform import Rotation

from drivesplat.kernels.numba import tiles
from drivesplat.rasterization import rasterize

WALL, TILT = 6.0, math.radians(60.0)


def arguments(scene: Scene) -> dict:
    return {f.name: getattr(scene, f.name) for f in fields(scene) if f.name != "colors"}


def surface_depth(scene: Scene, **options) -> torch.Tensor:
    return rasterize(**arguments(scene), colors=scene.colors, with_surface_depth=True, **options).surface_depth


def tilted_wall(opacity: float, behind: float | None = None) -> tuple[Scene, torch.Tensor]:
    """Flat Gaussians in a plane that is turned by TILT about the vertical, WALL metres ahead on the camera's axis, and
    its depth (h, w). With `behind`, one more Gaussian at that depth fills the image."""
    across, up = np.meshgrid(np.arange(-9.0, 9.01, 0.25), np.arange(-4.0, 4.01, 0.25))
    turn = Rotation.from_euler("y", TILT)
    at = turn.apply(np.stack([across.ravel(), up.ravel(), np.zeros(across.size)], axis=1))
    at[:, 2] += WALL
    near = at[:, 2] > 0.5
    count = near.sum()
    x, y, z, w = turn.as_quat()
    means, quats = at[near], np.tile([w, x, y, z], (count, 1))
    scales, opacities = np.tile([0.25, 0.25, 0.002], (count, 1)), np.full(count, opacity)
    if behind is not None:
        means = np.concatenate([means, [[0.0, 0.0, behind]]])
        quats = np.concatenate([quats, [[1.0, 0.0, 0.0, 0.0]]])
        scales, opacities = np.concatenate([scales, [[behind] * 3]]), np.append(opacities, 0.99)
    width, height, focal = 60, 40, 60.0
    k = [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]
    arrays = {
        "means": means, "quats": quats, "scales": scales, "opacities": opacities, "colors": np.zeros((len(means), 1)),
        "viewmats": np.eye(4)[None], "Ks": np.array([k]),
    }  # fmt: skip
    scene = Scene(**{name: torch.from_numpy(value) for name, value in arrays.items()}, width=width, height=height)
    slope = (torch.arange(width) + 0.5 - width / 2) / focal
    return scene, (WALL / (1.0 + slope * math.tan(TILT))).expand(height, width)


def relative_error(found: torch.Tensor, known: torch.Tensor, where: slice) -> float:
    return float(((found - known).abs() / known)[:, where].median())


def test_a_tilted_surface_has_its_own_depth():
    """Between the centres of its Gaussians, too, which the expected depth of centres does not know."""
    scene, known = tilted_wall(0.6)
    right_half = slice(30, 60)
    expected = rasterize(**arguments(scene), colors=scene.colors, with_depth=True).depth[0, ..., 0]
    assert relative_error(surface_depth(scene)[0], known, right_half) < 0.01
    assert relative_error(expected, known, right_half) > 0.02


def test_what_shows_through_a_surface_does_not_move_it():
    (closed, known), (leaking, _) = tilted_wall(0.3), tilted_wall(0.3, behind=200.0)
    where = slice(30, 60)
    passes = 1.0 - rasterize(**arguments(closed), colors=closed.colors).alpha[0, :, where].median()
    assert 0.005 < passes < 0.3
    expected = rasterize(**arguments(leaking), colors=leaking.colors, with_depth=True).depth[0, ..., 0]
    assert relative_error(surface_depth(leaking)[0], known, where) < 1e-2
    assert relative_error(expected, known, where) > 0.1


def test_without_gaussians_the_depth_is_zero():
    scene = random_scene(0, n=3, width=40, height=30)
    nothing = {name: getattr(scene, name)[:0] for name in ("means", "quats", "scales", "opacities", "colors")}
    found = surface_depth(replace(scene, **nothing))
    assert not found.any() and found.shape == (1, 30, 40)


def test_gaussians_behind_the_camera_and_at_its_place_are_left_out():
    scene = random_scene(1, n=40, width=40, height=30)
    means = torch.cat([scene.means, torch.tensor([[0.0, 0.0, -3.0], [0.0, 0.0, 0.0]], dtype=torch.float64)])
    more = {name: torch.cat([getattr(scene, name), getattr(scene, name)[:2]]) for name in ("quats", "scales")}
    more["colors"] = torch.cat([scene.colors, scene.colors[:2]])
    both = replace(scene, means=means, **more, opacities=torch.cat([scene.opacities, torch.ones(2).double()]))
    at_origin = replace(both, viewmats=torch.eye(4, dtype=torch.float64)[None])
    alone = replace(scene, viewmats=at_origin.viewmats)
    torch.testing.assert_close(surface_depth(at_origin), surface_depth(alone), rtol=0.0, atol=0.0)


def test_neither_threads_nor_windows_of_lists_change_it(monkeypatch):
    scene = random_scene(2, n=200, width=70, height=50).float()
    expected = surface_depth(scene)
    before = torch.get_num_threads()
    monkeypatch.setattr(tiles, "MAX_ENTRIES", 50)
    try:
        torch.set_num_threads(3)
        torch.testing.assert_close(surface_depth(scene), expected, rtol=0.0, atol=0.0)
    finally:
        torch.set_num_threads(before)
