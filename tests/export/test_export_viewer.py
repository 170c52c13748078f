"""viewer.html as text, decoded again, and in a browser where there is one: it shows what the model renders."""

import base64
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.chromium import in_a_browser
from helpers.hand_made import recording_of, round_gaussians
from helpers.hand_made_traffic import TRAJECTORIES, Traffic, own_gaussians, placed
from helpers.records import EMPTY_CHECKPOINT
from helpers.viewer_pages import (
    CAR,
    PROVENANCE,
    a_model,
    a_sky,
    car_pose,
    driving_car,
    oblique_frame,
    page_of,
    path_from,
    psnr,
    rendered,
    set_second,
    settled,
    splats,
    tick,
)
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.export import viewer
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.viewer import export_viewer, viewer_page
from drivesplat.export.viewer_scene import ViewerContent, packed, sky_faces
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.model.gaussians import concatenate
from drivesplat.model.part import Sky
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.rigid import rigid
from drivesplat.settings.export import ViewerJob
from drivesplat.settings.train import GaussianSettings, TrainJob, TrainSettings

KEPT = 40


@pytest.fixture(scope="module")
def page(tmp_path_factory, tiny_scene) -> str:
    model = a_model(splats(), CubemapSky(8, torch.tensor([0.4, 0.6, 0.8]), 0.01))
    settings = TrainSettings(gaussians=GaussianSettings(sh_degree=2), sky_resolution=8)
    train = TrainJob(parts=("background",), sky="cubemap", train=settings, random_seed=0)
    checkpoint, record = TrainedCheckpoint.of(model, train, PROVENANCE), recording_of(tiny_scene).record
    path, job = tmp_path_factory.mktemp("viewer") / "viewer.html", ViewerJob(eval_camera="CAM_FRONT", gaussians=KEPT)
    export_viewer(path, checkpoint, tiny_scene, record, job, "vanilla", (), PROVENANCE)
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
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.S)
    assert "default-src 'none'" in page and "connect-src" not in page
    assert re.findall(r"""\b(?:src|href|srcset|action|data)\s*=\s*["']?([^"'\s>]+)""", markup) == ["data:,"]
    assert not re.search(r"https?:|wss?:|@import|url\(|\bimport\b", page)
    assert not re.search(r"\b(fetch|importScripts|XMLHttpRequest|WebSocket|EventSource|sendBeacon)\b", page)
    assert re.findall(r"\bnew \w*Worker\((\w+)", page) == ["address"] and "worker-src blob:" in page


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


def test_objects_are_in_their_own_frames_with_their_motions(tmp_path, tiny_scene, monkeypatch):
    """Two vehicles, of which one is absent at the middle image; beside a background without view dependence."""
    model = SplatModel([round_gaussians([[1.0, 2.0, 3.0]]), Traffic()], None)
    monkeypatch.setattr(viewer, "trained_model", lambda _: model)
    job, record = ViewerJob(eval_camera="CAM_FRONT", gaussians=1000), recording_of(tiny_scene).record
    export_viewer(tmp_path / "viewer.html", EMPTY_CHECKPOINT, tiny_scene, record, job, "street", (), PROVENANCE)
    scene, arrays = decoded((tmp_path / "viewer.html").read_text(encoding="utf-8"))
    own = {name: own_gaussians(name, 2.25) for name in TRAJECTORIES}
    numbers = {record["name"]: number for number, record in enumerate(scene["groups"])}
    assert scene["count"] == 1 + sum(map(len, own.values())) and not scene["has_sky"]
    assert set(own) < set(numbers) and scene["groups"][0]["samples"] is None
    owner = np.repeat(np.arange(len(numbers)), [group["gaussians"] for group in scene["groups"]])
    for name, gaussians in own.items():
        rows, record = owner == numbers[name], scene["groups"][numbers[name]]
        np.testing.assert_allclose(arrays["means"].reshape(-1, 3)[rows], gaussians.means, atol=1e-5)
        np.testing.assert_allclose(arrays["sh0"].reshape(-1, 3)[rows], gaussians.sh[:, 0], atol=1e-3)
        first, last = record["samples"]
        seconds, poses = arrays["motion_seconds"][first:last], arrays["motion_poses"].reshape(-1, 3, 4)[first:last]
        assert len(seconds) > 30 and (np.diff(seconds) > 0).all()
        for second, pose in zip(seconds[::9], poses[::9], strict=True):
            assert any(begin - 1e-3 <= second <= end + 1e-3 for begin, end in record["present"])
            np.testing.assert_allclose(pose, TRAJECTORIES[name].pose(second)[:3], atol=2e-3)
    assert [len(scene["groups"][numbers[name]]["present"]) for name in own] == [1, 2]


def test_title_and_provenance_are_escaped_and_the_page_is_deterministic_and_of_bounded_size(page):
    assert "<title>0001 · vanilla</title>" in page
    assert json.loads(element(page, "provenance")) == PROVENANCE
    assert "<b>" not in page
    assert "<title>&lt;i&gt; {{scene}}</title>" in page_of(splats(), None, title="<i> {{scene}}")
    again = [page_of(splats(), a_sky(), antialiased=True) for _ in range(2)]
    assert again[0] == again[1]
    # 12 + 6 + 8 + 1 + 6 + 24 + 2 bytes a Gaussian and the sky, in base64 at worst; the rest of the page
    assert len(page) < 1.34 * (59 * KEPT + 6 * 256**2 * 3) + 80_000


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


@in_a_browser
@pytest.mark.parametrize("antialiased", [False, True])
def test_a_browser_renders_the_page_from_disk_as_the_model_does(tmp_path, opened, antialiased):
    gaussians, sky, frame = splats(400, sh_degree=3), a_sky(), oblique_frame()
    if antialiased:  # small enough for it to matter
        gaussians = replace(gaussians, scales=0.2 * gaussians.scales)
        plain = rendered(a_model(gaussians, sky, antialiased=False), frame.camera_to_world)
        assert psnr(plain, rendered(a_model(gaussians, sky, antialiased), frame.camera_to_world)) < 35.0
    model, pose = a_model(gaussians, sky, antialiased), frame.camera_to_world
    with opened(page_of(gaussians, sky, antialiased)) as tab:
        start = settled(tab)
        tab.mouse("mousePressed", 100, 60, button="left", clickCount=1)
        tab.mouse("mouseMoved", 130, 60, button="left", buttons=1)
        tab.mouse("mouseReleased", 130, 60, button="left", clickCount=1)
        dragged = settled(tab)
        tab.key("KeyR", "r")
        restarted = settled(tab)
        tab.mouse("mouseWheel", 100, 60, deltaX=0, deltaY=-100)
        wheeled = settled(tab)
        assert {url for url in tab.requests if not url.startswith(("data:", "blob:null/"))} == {
            (tmp_path / "viewer.html").as_uri()
        }
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
def test_objects_move_with_the_time_and_can_be_hidden_and_picked(opened):
    street, car, sky, frame = splats(200, sh_degree=1), driving_car(), a_sky(), oblique_frame()
    camera = frame.camera_to_world
    groups = {"background": SampledGroup(street), CAR: car}
    page = viewer_page(ViewerContent(groups, sky, False, path_from(frame)), "test", {})

    def expected(second: float | None, pose: np.ndarray = camera, behind: Sky | None = sky) -> np.ndarray:
        parts = [street] if second is None else [street, placed(car.gaussians, car_pose(second))]
        return rendered(a_model(concatenate(parts), behind), pose)

    with opened(page) as tab:
        assert psnr(settled(tab), expected(0.0)) > 40.0
        tab.run(set_second(1.2))
        there = settled(tab)
        assert psnr(there, expected(1.2)) > 40.0 > 35.0 > psnr(there, expected(0.0))
        tab.run(tick("vehicle.car"))
        hidden = settled(tab)
        assert psnr(hidden, expected(None)) > 40.0
        changed, own = np.abs(hidden - there).max(axis=2) > 0.02, np.abs(expected(1.2) - expected(None)).max(axis=2)
        assert changed.any() and not (changed & (own < 0.004)).any(), "only the car's pixels"
        tab.run(tick("sky"))
        assert psnr(settled(tab), expected(None, behind=None)) > 40.0
        tab.run(f"{tick('vehicle.car')}; {tick('sky')}; {set_second(1.8)}")
        assert psnr(settled(tab), expected(None)) > 40.0, "absent by then"
        tab.run(set_second(1.0))
        for kind, buttons in (("mousePressed", 1), ("mouseReleased", 0)):
            middle = (250.5 + 0.5) / 2, (122.25 + 0.5) / 2
            tab.mouse(kind, round(middle[0]), round(middle[1]), button="left", buttons=buttons, clickCount=1)
        about, step = (tab.run(f'document.getElementById("{name}").textContent') for name in ("about", "step"))
        assert about.startswith(f"vehicle.car {CAR} · 3.0 m/s") and step == f'- remove: {{track: "{CAR[:8]}"}}'
        tab.run(f'{set_second(0.5)}; document.getElementById("follow").click()')
        ahead = rigid(camera[:3, :3], camera[:3, 3] + 0.5 * camera[:3, 2])
        assert psnr(settled(tab), expected(0.5, ahead)) > 40.0


@in_a_browser
def test_play_moves_the_time_on_and_buttons_jump_to_key_frames(opened):
    clock = 'Number.parseFloat(document.getElementById("clock").textContent)'
    with opened(page_of(splats(), None)) as tab:
        assert tab.run(clock) == 0.0
        for button, second in (("next", 0.5), ("next", 2.0), ("previous", 0.5)):
            tab.run(f'document.getElementById("{button}").click()')
            settled(tab)
            assert tab.run(clock) == second
        tab.run('document.getElementById("play").click()')
        tab.run("new Promise((done) => setTimeout(done, 400))")
        tab.run('document.getElementById("play").click()')
        settled(tab)
        stopped = tab.run(clock)
        assert 0.6 < stopped < 2.0
        settled(tab)
        assert tab.run(clock) == stopped
