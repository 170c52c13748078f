"""viewer.html as text, decoded again, and in a browser where there is one: it shows what the model renders."""

import base64
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.chromium import chromium, in_a_browser
from helpers.hand_made import round_gaussians
from helpers.hand_made_traffic import TRAJECTORIES, TURNING, Traffic, own_gaussians, placed
from helpers.records import EMPTY_CHECKPOINT
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.export import viewer
from drivesplat.export.viewer import export_viewer, packed, sky_faces, viewer_page
from drivesplat.model.background import Background
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.part import Sky
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import View
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame
from drivesplat.settings.export import ExportJob
from drivesplat.settings.train import GaussianSettings, TrainJob, TrainSettings

COUNT, KEPT = 60, 40
PROVENANCE = {"settings_sha256": "a" * 64, "stages": {"train": {"note": "</script><b>"}}}
WIDTH, HEIGHT = 240, 135
SHOWN_WITHOUT_WORDS = """new Promise((done) => {
  const look = () => document.documentElement.dataset.shown === "yes" ? done() : setTimeout(look, 20);
  look();
}).then(() => document.querySelectorAll("p").forEach((p) => (p.hidden = true)))"""


def splats(count: int = COUNT, sh_degree: int = 2) -> Gaussians:
    """In front of `oblique_frame`."""
    generator = torch.Generator().manual_seed(3)
    random = torch.rand(count, 7, generator=generator)
    places = torch.stack([12.0 * random[:, 0] - 6.0, 6.0 * random[:, 1] - 3.0, 5.0 + 15.0 * random[:, 2]], dim=1)
    pose = torch.from_numpy(oblique_frame().camera_to_world).float()
    sh = torch.randn(count, (sh_degree + 1) ** 2, 3, generator=generator)
    sh[:, 1:] *= 0.2
    return Gaussians.of(
        places @ pose[:3, :3].T + pose[:3, 3], torch.randn(count, 4, generator=generator),
        0.02 + 0.8 * random[:, 3:6] ** 3, 0.05 + 0.95 * random[:, 6], sh,
    )  # fmt: skip


def oblique_frame() -> Frame:
    """A camera that is pitched and rolled a little, its principal point off the middle, at half of 480 x 270."""
    down_right = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    turned = Rotation.from_euler("zyx", [0.7, 0.08, 0.03]).as_matrix() @ down_right
    pose = rigid(turned, np.array([5.0, -3.0, 1.6]))
    K = np.array([[410.0, 0.0, 250.5], [0.0, 400.0, 122.25], [0.0, 0.0, 1.0]])
    return Frame("CAM_FRONT", 0, "", 480, 270, K, pose, np.eye(4), True, 0, "")


def a_sky() -> CubemapSky:
    sky = CubemapSky(8, torch.tensor([0.4, 0.6, 0.8]), 0.01)
    with torch.no_grad():
        sky.params["texels"].add_(
            0.5 * torch.randn(sky.params["texels"].shape, generator=torch.Generator().manual_seed(1))
        )
    return sky


def a_model(gaussians: Gaussians, sky: Sky | None, antialiased: bool = False) -> SplatModel:
    params = {
        "means": gaussians.means, "quats": gaussians.quats, "scales": torch.log(gaussians.scales),
        "opacities": torch.logit(gaussians.opacities), "sh0": gaussians.sh[:, :1], "shN": gaussians.sh[:, 1:],
    }  # fmt: skip
    return SplatModel([Background(params, GaussianSettings(sh_degree=gaussians.sh_degree), 1.0)], sky, antialiased)


@pytest.fixture(scope="module")
def checkpoint():
    model = a_model(splats(), CubemapSky(8, torch.tensor([0.4, 0.6, 0.8]), 0.01))
    settings = TrainSettings(gaussians=GaussianSettings(sh_degree=2), sky_resolution=8)
    job = TrainJob(parts=("background",), sky="cubemap", train=settings, random_seed=0)
    return TrainedCheckpoint.of(model, job, PROVENANCE)


@pytest.fixture(scope="module")
def page(tmp_path_factory, checkpoint, tiny_scene) -> str:
    path = tmp_path_factory.mktemp("viewer") / "viewer.html"
    job = ExportJob(eval_camera="CAM_FRONT", gaussians=KEPT)
    export_viewer(path, checkpoint, tiny_scene, job, "vanilla", PROVENANCE)
    return path.read_text(encoding="utf-8")


def element(page: str, name: str) -> str:
    return re.search(rf'<script type="[^"]*" id="{name}">(.*?)</script>', page, re.S)[1]


def decoded(page: str) -> tuple[dict, dict[str, np.ndarray]]:
    """The page's record of the scene and its arrays, flat."""
    scene = json.loads(element(page, "scene"))
    content = zlib.decompress(base64.b64decode(element(page, "payload")))
    arrays = {
        a["name"]: np.frombuffer(content, np.dtype(a["dtype"]).newbyteorder("<"), a["length"], a["offset"])
        for a in scene["arrays"]
    }
    return scene, arrays


def test_the_page_has_no_address_to_request(page):
    assert "default-src 'none'" in page and "connect-src" not in page
    assert re.findall(r"""\b(?:src|href|srcset|action|data)\s*=\s*["']?([^"'\s>]+)""", page) == ["data:,"]
    assert not re.search(r"https?:|wss?:|@import|url\(|\bimport\b", page)
    assert not re.search(r"\b(fetch|importScripts|XMLHttpRequest|WebSocket|EventSource|sendBeacon|Worker)\b", page)


def test_the_payload_has_the_gaussians_of_largest_coverage(page):
    gaussians = splats()
    areas = gaussians.scales.sort(dim=1).values[:, 1:].prod(dim=1)
    covered = gaussians.opacities * areas.clamp(max=10.0 * float(areas.median()))
    expected = gaussians[covered.argsort(descending=True)[:KEPT].sort().values]
    scene, arrays = decoded(page)
    assert scene["count"] == KEPT and scene["coefficients"] == 9 and not scene["antialiased"]
    np.testing.assert_array_equal(arrays["means"].reshape(-1, 3), expected.means)
    np.testing.assert_allclose(arrays["scales"].reshape(-1, 3), expected.scales, rtol=1e-3)
    unit = expected.quats / expected.quats.norm(dim=1, keepdim=True)
    np.testing.assert_allclose(arrays["quats"].reshape(-1, 4), unit, atol=5e-4)
    np.testing.assert_allclose(arrays["opacities"] / 255.0, expected.opacities, atol=0.5 / 255.0 + 1e-6)
    np.testing.assert_allclose(arrays["sh0"].reshape(-1, 3), expected.sh[:, 0], rtol=1e-3, atol=1e-6)
    root = arrays["shN"].astype(float).reshape(-1, 8, 3) / 127.0
    np.testing.assert_allclose(scene["sh_range"] * root * abs(root), expected.sh[:, 1:], atol=scene["sh_range"] / 120)


def test_objects_present_at_the_middle_image_are_placed_there(tmp_path, tiny_scene, monkeypatch):
    """Two vehicles, of which one is absent then; beside a background without view dependence."""
    model = SplatModel([round_gaussians([[1.0, 2.0, 3.0]]), Traffic()], None)
    monkeypatch.setattr(viewer, "trained_model", lambda _: model)
    job = ExportJob(eval_camera="CAM_FRONT", gaussians=1000)
    export_viewer(tmp_path / "viewer.html", EMPTY_CHECKPOINT, tiny_scene, job, "street", PROVENANCE)
    scene, arrays = decoded((tmp_path / "viewer.html").read_text(encoding="utf-8"))
    there = placed(own_gaussians(TURNING, 2.25), TRAJECTORIES[TURNING].pose(2.25))
    assert (scene["count"], scene["coefficients"]) == (1 + len(there), 4)
    np.testing.assert_allclose(arrays["means"].reshape(-1, 3), [[1.0, 2.0, 3.0], *there.means.tolist()], atol=1e-5)
    np.testing.assert_allclose(arrays["sh0"].reshape(-1, 3)[1:], there.sh[:, 0], atol=1e-3)


def test_a_splat_without_view_dependence_is_written():
    scene, arrays = decoded(viewer_page(splats(sh_degree=0), None, False, oblique_frame(), "t", {}))
    assert scene["coefficients"] == 1 and len(arrays["shN"]) == 0 and not arrays["sky"].any()


def test_the_start_is_the_middle_key_frame_of_the_evaluated_camera(page, tiny_scene):
    keys = sorted(f.timestamp for f in tiny_scene.frames if f.camera == "CAM_FRONT" and f.is_key_frame)
    frame = next(f for f in tiny_scene.frames if f.timestamp == keys[len(keys) // 2])
    start = decoded(page)[0]["start"]
    np.testing.assert_array_equal(start["camera_to_world"], frame.camera_to_world)
    np.testing.assert_allclose(start["K"], np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]) + frame.intrinsics)
    assert (start["width"], start["height"]) == (frame.width, frame.height)


def test_title_and_provenance_are_escaped(page):
    assert "<title>0001 · vanilla</title>" in page
    assert json.loads(element(page, "provenance")) == PROVENANCE
    assert "<b>" not in page
    assert "<title>&lt;i&gt; {{scene}}</title>" in viewer_page(
        splats(), None, False, oblique_frame(), "<i> {{scene}}", {}
    )


def test_the_page_is_deterministic_and_of_bounded_size(page):
    again = [viewer_page(splats(), a_sky(), True, oblique_frame(), "t", PROVENANCE) for _ in range(2)]
    assert again[0] == again[1]
    # 12 + 6 + 8 + 1 + 6 + 24 bytes a Gaussian and the sky, in base64 at worst; the rest of the page
    assert len(page) < 1.34 * (57 * KEPT + 6 * 256**2 * 3) + 40_000


def test_arrays_are_aligned_for_every_type():
    layout, _ = packed({"a": np.zeros(3, np.uint8), "b": np.zeros(2, np.float32), "c": np.zeros(1, np.float16)})
    assert [entry["offset"] for entry in layout] == [0, 4, 12]


class DirectionSky(Sky):
    """A colour that spells the direction."""

    params = nn.ParameterDict()
    keeps_gaussians_out = False

    def colors(self, rays):
        return 0.5 + 0.5 * rays

    def learning_rates(self):
        return {}


def test_the_sky_has_the_orientation_of_opengl():
    size, faces = 64, sky_faces(DirectionSky(), 64)
    rays = np.random.default_rng(0).normal(size=(200, 3))
    for x, y, z in rays / np.linalg.norm(rays, axis=1, keepdims=True):
        # OpenGL 4.5, table 8.19: the face by the largest coordinate, then s and t
        table = {0: (x, -z, -y), 1: (-x, z, -y), 2: (y, x, z), 3: (-y, x, -z), 4: (z, x, -y), 5: (-z, -x, -y)}
        face = max(table, key=lambda f: table[f][0])
        major, s, t = table[face]
        column, row = (int((0.5 * (c / major) + 0.5) * size) for c in (s, t))
        np.testing.assert_allclose(faces[face, row, column] / 127.5 - 1.0, [x, y, z], atol=2.5 / size)


def rendered(model: SplatModel, pose: np.ndarray) -> np.ndarray:
    """What the model shows to a camera like `oblique_frame` at half its size: (135, 240, 3) in [0, 1]."""
    frame = oblique_frame()
    K = torch.from_numpy(frame.intrinsics).float()
    K[:2, 2] += 0.5
    K[:2] *= 0.5
    with torch.no_grad():
        return model.render(View(K, torch.from_numpy(pose).float(), WIDTH, HEIGHT, 0.0)).image.clamp(0, 1).numpy()


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((a - b) ** 2)))


@in_a_browser
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_browser_renders_the_page_from_disk_as_the_model_does(tmp_path, antialiased):
    gaussians, sky, frame = splats(400, sh_degree=3), a_sky(), oblique_frame()
    if antialiased:  # small enough for it to matter
        gaussians = replace(gaussians, scales=0.2 * gaussians.scales)
        plain = rendered(a_model(gaussians, sky, antialiased=False), frame.camera_to_world)
        assert psnr(plain, rendered(a_model(gaussians, sky, antialiased), frame.camera_to_world)) < 35.0
    model, pose = a_model(gaussians, sky, antialiased), frame.camera_to_world
    file = tmp_path / "viewer.html"
    file.write_text(viewer_page(gaussians, sky, antialiased, frame, "test", {}), encoding="utf-8")
    with chromium(tmp_path / "profile") as tab:
        tab.open(file, WIDTH, HEIGHT)
        tab.run(SHOWN_WITHOUT_WORDS)
        start = tab.picture()
        tab.mouse("mousePressed", 100, 60, button="left", clickCount=1)
        tab.mouse("mouseMoved", 130, 60, button="left", buttons=1)
        tab.mouse("mouseReleased", 130, 60, button="left", clickCount=1)
        dragged = tab.picture()
        tab.key("KeyR", "r")
        restarted = tab.picture()
        tab.mouse("mouseWheel", 100, 60, deltaX=0, deltaY=-100)
        wheeled = tab.picture()
        assert tab.complaints == []
        assert {url for url in tab.requests if not url.startswith("data:")} == {file.as_uri()}
    assert psnr(start, rendered(model, pose)) > 40.0
    np.testing.assert_array_equal(restarted, start)
    # the street follows the mouse: 30 pixels to the right turn the camera left by 30 / fx, about the world's z
    left = Rotation.from_euler("z", 30.0 / 205.0).as_matrix() @ pose[:3, :3]
    assert psnr(dragged, rendered(model, rigid(left, pose[:3, 3]))) > 40.0
    # a notch of the wheel is a metre forward
    ahead = rigid(pose[:3, :3], pose[:3, 3] + pose[:3, 2])
    assert psnr(wheeled, rendered(model, ahead)) > 40.0
    assert psnr(start, dragged) < 35.0 > psnr(start, wheeled)


@in_a_browser
def test_requests_and_errors_of_the_page_are_detected(tmp_path):
    page = viewer_page(splats(), None, False, oblique_frame(), "test", {})
    file = tmp_path / "viewer.html"
    file.write_text(page.replace('"use strict";', '"use strict"; fetch("https://example.org/x");', 1), encoding="utf-8")
    with chromium(tmp_path / "profile") as tab:
        tab.open(file, WIDTH, HEIGHT)
        tab.run(SHOWN_WITHOUT_WORDS)
        assert any("Content Security Policy" in complaint for complaint in tab.complaints)
