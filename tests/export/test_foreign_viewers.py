"""splat.ply and splat.spz of both methods in web viewers of other projects: they draw it, and read it whole.

The packages are pinned in foreign/package.json and not part of the project.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlencode

import numpy as np
import pytest
import torch
from helpers import REPOSITORY
from helpers.chromium import chromium, in_a_browser
from helpers.hand_made import looking_at, recording_of, round_gaussians
from helpers.hand_made_street import checkpoint_of, street_actors, street_scene
from helpers.loopback import served

from drivesplat.export.compressed import export_spz
from drivesplat.export.far_gaussians import find_far, within_reach
from drivesplat.export.splat_asset import SplatFiles, export_splat
from drivesplat.model.background import Background
from drivesplat.model.checkpoint import trained_model
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.splat_ply import read_splat_ply
from drivesplat.settings.export import MAX_DISTANCE, SplatJob
from drivesplat.settings.train import GaussianSettings, TrainSettings
from drivesplat.settings.train_objects import ActorSettings

FOREIGN = Path(__file__).parent / "foreign"
INSTALL = f"npm install --prefix {FOREIGN.relative_to(REPOSITORY)}"
PROVENANCE = {"settings_sha256": "a" * 64, "code_sha256": "b" * 64, "inputs_sha256": "c" * 64, "stages": {}}
SETTINGS = TrainSettings(gaussians=GaussianSettings(sh_degree=2), actors=ActorSettings(fourier=2))
WIDTH, HEIGHT = 320, 200
CAMERA, TARGET = (-2.0, 0.0, 1.5), (8.0, 0.0, 1.5)
"""Behind the street's begin, with a view along it."""
METHODS = ("vanilla", "street")
PLY_READERS = ("gaussian_splats_3d", "spark", "playcanvas")


def with_packages(test):
    """Marks a test that needs Chromium and the packages of foreign/package.json."""
    missing = not (FOREIGN / "node_modules").is_dir()
    return in_a_browser(pytest.mark.skipif(missing, reason=f"other viewers are not installed: {INSTALL}")(test))


def street(method: str) -> SplatModel:
    """3,000 Gaussians with harmonics along a road, on which objects drive with `street`; behind it Gaussians up
    to 90 km away, most of them faint, and a red disc of two degrees in the sky, which every camera sees."""
    rng = np.random.default_rng(0)
    near = rng.uniform([4.0, 5.0, -0.5], [60.0, 12.0, 6.0], (3000, 3))
    near[::2, 1] *= -1.0
    away = rng.normal(size=(40, 3))
    away *= (np.geomspace(1.2e3, 9e4, 40) / np.linalg.norm(away, axis=1))[:, None]
    places = np.concatenate([near, away, [[8e4, 0.0, 2e4]]])
    sizes = np.concatenate([np.full(3000, 0.25), np.full(40, 0.5), [3e3]])
    opacities = np.concatenate([np.full(3000, 0.9), np.full(40, 0.003), [0.9]])
    colors = np.concatenate([rng.uniform(0.3, 1.0, (3040, 3)), [[1.0, 0.0, 0.0]]])
    params = dict(round_gaussians(places, sizes, opacities, colors).params)
    params["shN"] = 0.1 * torch.from_numpy(rng.normal(size=(len(places), 8, 3))).float()
    background = Background(params, SETTINGS.gaussians, 1.0)
    parts = [background, street_actors()] if method == "street" else [background]
    return SplatModel(parts, ConstantSky(torch.tensor([0.3, 0.5, 0.8]), 1e-2)).requires_grad_(False)


@pytest.fixture(scope="module")
def exported(tmp_path_factory, tiny_scene) -> Path:
    """A folder with a splat.ply and a splat.spz for each method."""
    folder = tmp_path_factory.mktemp("exported")
    scene = street_scene(tiny_scene)
    views = [looking_at([x + 10.0, 0.0, 1.5], [x, 0.0, 1.5], time=0.4 * x) for x in range(4)]
    for method in METHODS:
        checkpoint = checkpoint_of(street(method), SETTINGS)
        far = find_far(trained_model(checkpoint), views, MAX_DISTANCE, PROVENANCE)
        assert len(far.removed) == 40 and len(far.moved) == 1
        names = ("splat.ply", "cameras.json", "parts/parts.json", "transforms.json")
        files = SplatFiles(*(folder / method / name for name in names))
        export_splat(files, within_reach(checkpoint, far), recording_of(scene).record, scene, SplatJob(), PROVENANCE)
        export_spz(folder / method / "splat.spz", files.splat)
    return folder


@dataclass(frozen=True)
class Shown:
    """What a viewer says of a file that it shows, and its window (h, w, 3) in [0, 1]."""

    count: int
    corners: np.ndarray
    picture: np.ndarray

    @property
    def share_drawn(self) -> float:
        """The share of pixels that are not black."""
        return float((self.picture.max(axis=2) > 0.05).mean())


@contextmanager
def a_browser(folder: Path, tmp_path: Path) -> Iterator[Callable[[str, str], Shown]]:
    """A function that shows a file below `folder` in a viewer that looks along the street."""
    folders = {"pages": FOREIGN, "node_modules": FOREIGN / "node_modules", "exported": folder}
    camera = {name: ",".join(map(str, point)) for name, point in (("position", CAMERA), ("target", TARGET))}
    with served(folders) as address, chromium(tmp_path / "profile") as tab:

        def show(viewer: str, file: str) -> Shown:
            query = urlencode({"file": f"/exported/{file}", **camera})
            tab.open(f"{address}/pages/{viewer}.html?{query}", WIDTH, HEIGHT)
            extent = tab.run("window.shown")
            assert extent, tab.complaints
            return Shown(extent["count"], np.array([extent["low"], extent["high"]]), tab.picture())

        yield show
        assert all(url.startswith((address, "blob:", "data:")) for url in tab.requests)


@with_packages
@pytest.mark.parametrize("viewer", PLY_READERS)
def test_a_web_viewer_draws_the_ply(exported, tmp_path, viewer):
    with a_browser(exported, tmp_path) as show:
        shown = {method: show(viewer, f"{method}/splat.ply") for method in METHODS}
    for method, by_viewer in shown.items():
        means = read_splat_ply(exported / method / "splat.ply").means.numpy()
        assert by_viewer.count == len(means) and np.linalg.norm(means, axis=1).max() <= MAX_DISTANCE
        np.testing.assert_allclose(by_viewer.corners, [means.min(axis=0), means.max(axis=0)], rtol=1e-3, atol=0.01)
        assert 0.3 < by_viewer.share_drawn < 0.95
    differing = np.abs(shown["street"].picture - shown["vanilla"].picture).max(axis=2) > 0.05
    assert 0.002 < differing.mean() < 0.3, "the objects"


@with_packages
def test_spark_reads_the_spz_as_the_ply(exported, tmp_path):
    with a_browser(exported, tmp_path) as show:
        ply, spz = (show("spark", f"street/splat.{kind}") for kind in ("ply", "spz"))
    assert spz.count == ply.count
    np.testing.assert_allclose(spz.corners, ply.corners, rtol=1e-3, atol=0.01)
    assert abs(spz.share_drawn - ply.share_drawn) < 0.02
    assert np.abs(spz.picture - ply.picture).mean() < 0.03
