"""Opening a trained model."""

import doctest

import torch
from helpers.hand_made import looking_at, round_gaussians
from helpers.hand_made_street import checkpoint_of, street_model

from drivesplat.model import checkpoint
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.settings.device import DeviceSettings


def test_the_example_of_open_model_renders_a_view(tmp_path, monkeypatch):
    folder = tmp_path / "results/0103/street"
    folder.mkdir(parents=True)
    checkpoint.write_checkpoint(folder / "checkpoint.npz", checkpoint_of(street_model()))
    monkeypatch.chdir(tmp_path)
    names = {**vars(checkpoint), "View": View}
    (example,) = doctest.DocTestFinder(recurse=False).find(checkpoint.open_model, "open_model", globs=names)
    assert len(example.examples) == 5
    assert doctest.DocTestRunner().run(example).failed == 0


def test_renderings_of_an_opened_model_limit_the_size_of_gaussians():
    model, _ = checkpoint.open_model(checkpoint_of(street_model()), DeviceSettings(kind="cpu"))
    assert model.max_scale == checkpoint.MAX_SCALE
    assert checkpoint.trained_model(checkpoint_of(street_model())).max_scale is None, (
        "trainings show Gaussians as they are"
    )


def test_a_limited_gaussian_is_shown_as_a_smaller_one_and_others_stay():
    """Three Gaussians, 5, 20 and 100 m away, of 2 m: with 0.1 the first is limited to 0.5 m."""
    places, view = (
        [[5.0, 0.0, 0.0], [20.0, 4.0, 0.0], [100.0, -25.0, 0.0]],
        looking_at([1.0, 0.0, 0.0], [0.0, 0.0, 0.0]),
    )
    shown, smaller = (SplatModel([round_gaussians(places, sizes)], None) for sizes in ([2.0] * 3, [0.5, 2.0, 2.0]))
    full = shown.render(view)
    shown.max_scale = 0.1
    with torch.no_grad():
        limited, expected = shown.render(view, with_surface_depth=True), smaller.render(view, with_surface_depth=True)
    torch.testing.assert_close(limited.alpha, expected.alpha)
    torch.testing.assert_close(limited.surface_depth, expected.surface_depth)
    assert float((full.alpha - limited.alpha).detach().max()) > 0.3
    assert torch.equal(limited.gaussians.scales, shown.gaussians_in(view).scales), "the model stays as it is"
