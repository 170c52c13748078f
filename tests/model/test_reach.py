"""Positions are bounded in place, and only those beyond the bound change."""

import numpy as np
import torch
from helpers.hand_made import round_gaussians

from drivesplat.model.reach import bound_positions


def test_only_positions_beyond_the_reach_move_and_only_towards_the_origin():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distances = np.geomspace(1.0, 5e6, 200)
    part = round_gaussians(distances[:, None] * directions, np.full(200, 0.1), np.full(200, 0.5), np.zeros((200, 3)))
    before, address = part.params["means"].detach().clone(), part.params["means"].data_ptr()
    bound_positions(part, 1000.0)
    after = part.params["means"].detach()
    inside = torch.from_numpy(distances <= 1000.0)
    assert part.params["means"].data_ptr() == address, "CUDA graphs know the address"
    assert torch.equal(after[inside], before[inside]) and inside.sum() > 50
    moved = after[~inside].double()
    assert bool((moved.norm(dim=1) <= 1000.0).all()) and bool((moved.norm(dim=1) > 999.9).all())
    assert torch.allclose(moved / moved.norm(dim=1, keepdim=True), torch.from_numpy(directions)[~inside], atol=1e-6)


def test_nan_and_inf_are_left_to_the_checks_that_report_them():
    part = round_gaussians(np.zeros((3, 3)), np.full(3, 0.1), np.full(3, 0.5), np.zeros((3, 3)))
    with torch.no_grad():
        part.params["means"][0, 1], part.params["means"][1, 2] = float("nan"), float("inf")
    before = part.params["means"].detach().clone()
    bound_positions(part, 1.0)
    assert torch.equal(part.params["means"].detach().nan_to_num(7.0), before.nan_to_num(7.0))
