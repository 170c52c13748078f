"""Points in Morton order: a permutation that keeps near points together."""

import torch

from drivesplat.kernels.morton import morton_order


def test_the_order_is_that_of_interleaved_bits():
    corners = torch.tensor([[float(x), float(y), float(z)] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    shuffled = torch.tensor([5, 2, 7, 0, 3, 6, 1, 4])
    assert shuffled[morton_order(corners[shuffled])].tolist() == list(range(8))


def test_every_row_is_there_once_and_equal_points_keep_their_order():
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0)).repeat(2, 1)
    order = morton_order(points)
    assert order.sort().values.tolist() == list(range(1000))
    first = order < 500
    assert torch.equal(order[first] + 500, order[~first])


def test_neighbours_in_the_order_are_near_each_other():
    points = torch.rand(4096, 3, generator=torch.Generator().manual_seed(1)) * torch.tensor([100.0, 100.0, 2.0])
    steps = points[morton_order(points)].diff(dim=0).norm(dim=1)
    assert steps.mean() < 0.1 * points.diff(dim=0).norm(dim=1).mean()


def test_no_points_and_one_place_have_an_order():
    assert morton_order(torch.zeros(0, 3)).tolist() == []
    assert morton_order(torch.full((3, 3), 7.0)).tolist() == [0, 1, 2]
