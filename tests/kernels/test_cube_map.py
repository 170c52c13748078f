"""An image over a cube map: numba's kernels agree with torch."""

import pytest
import torch
from scipy.spatial.transform import Rotation

from drivesplat.kernels.cube_map import CubeMap, over_cube_map
from drivesplat.model.sky import CubemapSky
from drivesplat.model.view import RollingShutter, View

HEIGHT, WIDTH = 37, 52


def a_view(seed: int, shutter: bool) -> View:
    torch.manual_seed(seed)
    pose = torch.eye(4)
    pose[:3, :3] = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
    K = torch.tensor([[18.0, 0.0, 25.0], [0.0, 16.0, 17.5], [0.0, 0.0, 1.0]])
    motion = torch.cat([torch.linalg.cross(torch.eye(3), torch.randn(3, 1).expand(3, 3), dim=0), torch.ones(3, 1)], 1)
    turning = RollingShutter(torch.tensor([0.03, -0.05, 0.01]), 4.0 * motion) if shutter else None
    return View(K, pose, WIDTH, HEIGHT, 0.0, shutter=turning)


@pytest.mark.parametrize(("seed", "shutter"), [(0, False), (1, True), (2, False), (3, True)])
def test_an_image_over_a_cube_map_and_its_gradients_agree_with_torch(seed, shutter):
    """Cameras that see edges and corners; opaque, transparent and mixed pixels. A camera with gradient takes torch."""
    view = a_view(seed, shutter)
    sky = CubemapSky(9, torch.tensor([0.3, 0.5, 0.7]), 1e-2)
    texels = sky.params["texels"].detach() + torch.randn(sky.params["texels"].shape)
    image, alpha = torch.rand(HEIGHT, WIDTH, 3), 0.998 * torch.rand(HEIGHT, WIDTH, 1)
    alpha[:5], alpha[5:9] = 0.0, 1.0
    weights = torch.randn(HEIGHT, WIDTH, 3)
    results = []
    for learned in (True, False):
        inputs = [values.clone().requires_grad_() for values in (image, alpha, texels)]
        pose = view.camera_to_world.clone().requires_grad_(learned)
        found = over_cube_map(*inputs[:2], CubeMap(inputs[2], sky.index), view.K, pose, view.rays, view.turning_by_line)
        (found * weights).sum().backward()
        results.append([found.detach(), *(values.grad for values in inputs)])
    for expected, given in zip(*results, strict=True):
        torch.testing.assert_close(given, expected, atol=2e-5, rtol=2e-4)
    assert results[0][3].abs().sum(dim=1).gt(0).float().mean() > 0.05


def test_a_trace_of_the_sky_behind_opaque_surfaces_does_not_change_it():
    view, sky = a_view(1, False), CubemapSky(9, torch.tensor([0.3, 0.5, 0.7]), 1e-2)
    alpha = torch.full((HEIGHT, WIDTH, 1), 0.9995, requires_grad=True)
    sky.behind(torch.zeros(HEIGHT, WIDTH, 3), alpha, view).sum().backward()
    assert not sky.params["texels"].grad.any() and (alpha.grad < 0.0).all()


def test_results_do_not_depend_on_the_number_of_threads(one_thread):
    view, results = a_view(1, False), []
    torch.manual_seed(5)
    image, given = torch.rand(HEIGHT, WIDTH, 3), torch.rand(HEIGHT, WIDTH, 1)
    for threads in (1, 2):
        torch.set_num_threads(threads)
        sky, alpha = CubemapSky(9, torch.tensor([0.3, 0.5, 0.7]), 1e-2), given.clone().requires_grad_()
        found = sky.behind(image, alpha, view)
        found.square().sum().backward()
        results.append([found.detach(), alpha.grad, sky.params["texels"].grad])
    for one, two in zip(*results, strict=True):
        assert torch.equal(one, two)


def test_texels_that_are_nan_or_extreme_show_as_such():
    """NaN must reach the loss, where a training notices it."""
    view, sky = a_view(1, False), CubemapSky(9, torch.tensor([0.3, 0.5, 0.7]), 1e-2)
    clear = torch.zeros(HEIGHT, WIDTH, 3), torch.zeros(HEIGHT, WIDTH, 1)
    with torch.no_grad():
        sky.params["texels"][:, 0], sky.params["texels"][:, 1], sky.params["texels"][:, 2] = torch.nan, 1e6, -1e6
        shown = sky.behind(*clear, view)
    assert shown[..., 0].isnan().all()
    torch.testing.assert_close(shown[..., 1:], torch.tensor([1.0, 0.0]).expand(HEIGHT, WIDTH, 2), atol=1e-6, rtol=0.0)
