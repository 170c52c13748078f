"""viewer.html as text, decoded again, and in a browser: it shows what the model renders, and does what a user asks."""

import base64
import io
import json
import re
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.chromium import chromium, in_a_browser
from helpers.hand_made import recording_of, round_gaussians
from helpers.hand_made_traffic import TRAJECTORIES, Traffic, own_gaussians, placed
from helpers.records import EMPTY_CHECKPOINT
from helpers.viewer_pages import (
    CAR,
    HEIGHT,
    PROVENANCE,
    SHOWN_WITHOUT_WORDS,
    WIDTH,
    a_model,
    a_sky,
    car_pose,
    choose,
    click,
    driving_car,
    oblique_frame,
    page_of,
    path_from,
    psnr,
    rendered,
    ridden,
    set_second,
    settled,
    splats,
    tick,
)
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import nn

from drivesplat.export import viewer
from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.viewer import export_viewer, key_frame_images, viewer_page
from drivesplat.export.viewer_scene import ViewerContent, packed, sky_faces
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.model.gaussians import Gaussians, concatenate, recolored
from drivesplat.model.part import Sky
from drivesplat.model.sky import CubemapSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.images import read_image
from drivesplat.scene.rigid import rigid
from drivesplat.settings.export import ViewerJob
from drivesplat.settings.train import GaussianSettings, TrainJob, TrainSettings
from drivesplat.trajectories.sampled_edit import CameraMotion, Instance, InstanceMotion, SampledEdit

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
    assert len(page) < 1.34 * (59 * KEPT + 6 * 256**2 * 3) + 100_000


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
        tab.run(f"{click('follow')}; {set_second(1.2)}")
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
        tab.run(f"{set_second(0.5)}; {click('follow')}")
        assert psnr(settled(tab), expected(0.5, ridden(0.5))) > 40.0


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


SIZE = np.array([4.0, 4.0, 4.0])


def beside(second: float) -> np.ndarray:
    """Where the copy is: four metres to the left of the car."""
    pose = car_pose(second)
    return rigid(pose[:3, :3], pose[:3, 3] - 4.0 * oblique_frame().camera_to_world[:3, 0])


def aside() -> np.ndarray:
    """The camera of the edit, a metre to the left."""
    pose = oblique_frame().camera_to_world
    return rigid(pose[:3, :3], pose[:3, 3] - pose[:3, 0])


def edits() -> list[SampledEdit]:
    """The car removed; and a copy of it, half as large, beside it from the second 0.5 on, seen from a metre aside."""
    seconds = np.linspace(0.5, 2.0, 46)
    motion = InstanceMotion(seconds, np.stack([beside(second) for second in seconds]), seconds, ((0.5, 2.0),))
    camera = CameraMotion(np.array([0.0, 2.0]), np.stack([aside(), aside()]))
    copied = (
        Instance(CAR, CAR, "vehicle.car", SIZE, 1.0, None),
        Instance("twin", CAR, "vehicle.car", SIZE, 0.5, motion),
    )
    painted = Instance(CAR, CAR, "vehicle.car", SIZE, 1.0, standing(), SWAPPED)
    return [SampledEdit("gone", (), None), SampledEdit("twins", copied, camera), SampledEdit("paint", (painted,), None)]


SWAPPED = np.array([[0.0, 0.8, 0.0], [0.1, 0.0, 0.7], [0.9, 0.0, 0.0]])
"""A map of colours that no transposed one equals."""


def standing() -> InstanceMotion:
    """The car as it is at the second 1."""
    ends = np.array([0.0, 2.0])
    return InstanceMotion(ends, np.stack([car_pose(1.0), car_pose(1.0)]), np.zeros(2), ((0.0, 2.0),))


def halved(gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, means=0.5 * gaussians.means, scales=0.5 * gaussians.scales)


@in_a_browser
def test_an_edit_plays_with_its_instances_and_its_camera(opened):
    street, car, sky, frame = splats(200, sh_degree=1), driving_car(), a_sky(), oblique_frame()
    groups = {"background": SampledGroup(street), CAR: car}
    page = viewer_page(ViewerContent(groups, sky, False, path_from(frame), edits=edits()), "test", {})

    def expected(*objects: Gaussians, pose: np.ndarray = frame.camera_to_world) -> np.ndarray:
        return rendered(a_model(concatenate([street, *objects]), sky), pose)

    own = placed(car.gaussians, car_pose(1.0))
    with opened(page) as tab:
        tab.run(f"{click('follow')}; {set_second(1.0)}; {choose('edit', 0)}")
        assert psnr(settled(tab), expected()) > 40.0 > 35.0 > psnr(settled(tab), expected(own))
        tab.run(choose("edit", 1))
        twins = own, placed(halved(car.gaussians), beside(1.0))
        assert psnr(settled(tab), expected(*twins)) > 40.0 > 35.0 > psnr(settled(tab), expected(own))
        tab.run(click("follow"))
        assert psnr(settled(tab), expected(*twins, pose=aside())) > 40.0
        assert tab.run('document.getElementById("followed").textContent') == "edited camera"
        tab.run(f"{tick('twin')}")
        assert psnr(settled(tab), expected(own, pose=aside())) > 40.0
        tab.run(f"{tick('twin')}; {set_second(0.2)}")
        assert psnr(settled(tab), expected(placed(car.gaussians, car_pose(0.2)), pose=aside())) > 40.0, "not there yet"
        tab.run(f"{set_second(1.0)}; {choose('edit', '')}")
        there = ridden(1.0)
        assert psnr(settled(tab), expected(own, pose=there)) > 40.0
        tab.run(choose("edit", 2))
        painted = recolored(own, torch.from_numpy(SWAPPED).float(), torch.ones(len(own), dtype=torch.bool))
        seen, plain = settled(tab), expected(own, pose=there)
        assert psnr(seen, expected(painted, pose=there)) > 40.0 > 35.0 > psnr(seen, plain)


def test_images_are_those_of_key_frames_and_say_whether_they_were_trained_on(tiny_scene):
    record = recording_of(tiny_scene, every_nth=4, offset=1).record
    images = key_frame_images(tiny_scene, record, "CAM_FRONT", 48)
    frames = [frame for frame in tiny_scene.frames if frame.is_key_frame]
    assert [image["second"] for image in images] == [tiny_scene.seconds(frame.timestamp) for frame in frames]
    trained = {int(record.timestamps[i]) for i in record.train_images}
    assert [image["trained"] for image in images] == [frame.timestamp in trained for frame in frames]
    assert {image["trained"] for image in images} == {True, False}
    for image, frame in zip(images, frames, strict=True):
        content = base64.b64decode(image["image"].removeprefix("data:image/jpeg;base64,"))
        shown = np.asarray(Image.open(io.BytesIO(content)))
        assert shown.shape == (27, 48, 3)
        assert psnr(shown / 255.0, read_image(frame.image_path, (48, 27)) / 255.0) > 25.0
    assert key_frame_images(tiny_scene, record, "CAM_FRONT", 0) == []


def plain_image(second: float, color: tuple[int, int, int]) -> dict:
    content = io.BytesIO()
    Image.new("RGB", (480, 270), color).save(content, format="PNG")
    data = base64.b64encode(content.getvalue()).decode()
    return {"second": second, "trained": False, "image": f"data:image/png;base64,{data}"}


@in_a_browser
def test_recorded_images_are_shown_over_and_beside_the_rendering(opened):
    frame, sky = oblique_frame(), a_sky()
    images = [plain_image(0.0, (255, 0, 0)), plain_image(0.5, (0, 0, 255))]
    groups = {"background": SampledGroup(splats(200, sh_degree=1))}
    page = viewer_page(ViewerContent(groups, sky, False, path_from(frame), images=images), "t", {})
    without_caption = 'document.getElementById("image-caption").style.visibility = "hidden"'
    with opened(page) as tab:
        start = settled(tab)
        tab.run(f"{without_caption}; {choose('image', 'over')}")
        over = settled(tab)
        np.testing.assert_allclose(over, 0.5 * start + 0.5 * np.array([1.0, 0.0, 0.0]), atol=0.02)
        caption = tab.run('document.getElementById("image-caption").textContent')
        assert caption == "recorded, 0.00 s, not trained on"
        tab.run(set_second(0.25))
        assert settled(tab)[..., 0].min() < 0.3, "between key frames there is no image over the rendering"
        tab.run(f"{set_second(0.5)}; {choose('image', 'beside')}")
        beside_it = settled(tab)
        right = beside_it[40:-40, WIDTH // 2 + 4 : -4]
        np.testing.assert_allclose(right, np.broadcast_to([0.0, 0.0, 1.0], right.shape), atol=0.01)
        assert not np.allclose(beside_it[:, : WIDTH // 2], [0.0, 0.0, 1.0], atol=0.1)
        tab.run(f"{choose('image', 'none')}; {set_second(0.0)}")
        np.testing.assert_array_equal(settled(tab), start)


@in_a_browser
def test_the_page_of_another_method_opens_with_the_same_camera_at_the_same_time(tmp_path):
    frame = oblique_frame()
    models = {"street": splats(200, sh_degree=1), "vanilla": splats(120, sh_degree=1)}
    for method, gaussians in models.items():
        groups = {"background": SampledGroup(gaussians)}
        content = ViewerContent(groups, None, False, path_from(frame), method=method, methods=[*models])
        for folder in (method, f"report/{method[:3]}"):
            (tmp_path / folder).mkdir(parents=True)
            (tmp_path / folder / "viewer.html").write_text(viewer_page(content, method, {}))
    opened = """new Promise((done) => {
      const look = () => document.title === "vanilla" ? done() : setTimeout(look, 20);
      look();
    })"""
    with chromium(tmp_path / "profile") as tab:
        tab.open(tmp_path / "street/viewer.html", WIDTH, HEIGHT)
        tab.run(SHOWN_WITHOUT_WORDS)
        tab.mouse("mouseWheel", 100, 60, deltaX=0, deltaY=-100)
        tab.run(set_second(1.5))
        before = settled(tab)
        tab.run(choose("method", "vanilla"))
        tab.wait_for_load()
        tab.run(opened)
        tab.run(SHOWN_WITHOUT_WORDS)
        after = settled(tab)
        ahead = rigid(frame.camera_to_world[:3, :3], frame.camera_to_world[:3, 3] + frame.camera_to_world[:3, 2])
        assert psnr(before, rendered(a_model(models["street"], None), ahead)) > 40.0
        assert psnr(after, rendered(a_model(models["vanilla"], None), ahead)) > 40.0
        assert tab.run('document.getElementById("clock").textContent') == "1.50 s"
        tab.open(tmp_path / "report/van/viewer.html", WIDTH, HEIGHT)
        assert tab.run('document.getElementById("method").hidden'), "elsewhere there may be no other page"
        assert tab.complaints == []


@in_a_browser
@pytest.mark.parametrize("worker", ["undefined", "class { postMessage() { setTimeout(() => this.onerror()); } }"])
def test_where_workers_are_refused_the_page_sorts_itself(opened, worker):
    gaussians, frame = splats(400, sh_degree=1), oblique_frame()
    with opened(
        page_of(gaussians, None).replace('"use strict";', f'"use strict"; window.Worker = {worker};', 1)
    ) as tab:
        tab.mouse("mouseWheel", 100, 60, deltaX=0, deltaY=-100)
        ahead = rigid(frame.camera_to_world[:3, :3], frame.camera_to_world[:3, 3] + frame.camera_to_world[:3, 2])
        assert psnr(settled(tab), rendered(a_model(gaussians, None), ahead)) > 40.0


@in_a_browser
def test_what_lies_behind_the_camera_is_not_drawn_while_the_order_is_an_old_one(opened):
    """A worker that never answers, and a camera that has passed all Gaussians, 20 metres ahead."""
    page = page_of(splats(400, sh_degree=1), None)
    with opened(page.replace('"use strict";', '"use strict"; window.Worker = class { postMessage() {} };', 1)) as tab:
        assert tab.picture().max() > 0.5
        tab.mouse("mouseWheel", 100, 60, deltaX=0, deltaY=-3000)
        assert tab.picture().max() == 0.0


@in_a_browser
def test_one_finger_looks_and_two_pan_and_zoom(tmp_path):
    gaussians, frame = splats(400, sh_degree=1), oblique_frame()
    model, pose = a_model(gaussians, None), frame.camera_to_world
    file = tmp_path / "viewer.html"
    file.write_text(page_of(gaussians, None), encoding="utf-8")

    def touch(tab, kind: str, *points: tuple[float, float]) -> None:
        found = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=found)

    with chromium(tmp_path / "profile") as tab:
        tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        tab.open(file, WIDTH, HEIGHT)
        tab.run(SHOWN_WITHOUT_WORDS)
        touch(tab, "touchStart", (100, 60))
        touch(tab, "touchMove", (130, 60))
        touch(tab, "touchEnd")
        looked = settled(tab)
        left = Rotation.from_euler("z", 30.0 / 205.0).as_matrix() @ pose[:3, :3]
        assert psnr(looked, rendered(model, rigid(left, pose[:3, 3]))) > 40.0
        tab.key("KeyR", "r")
        touch(tab, "touchStart", (80, 60), (120, 60))
        touch(tab, "touchMove", (90, 60), (140, 60))  # the middle goes 15 pixels to the right, 40 apart become 50
        touch(tab, "touchEnd")
        pinched = settled(tab)
        assert tab.complaints == []
    moved = pose[:3, 3] + pose[:3, :3] @ np.array([-10.0 * 15.0 / 205.0, 0.0, 10.0 * np.log(50.0 / 40.0)])
    assert psnr(pinched, rendered(model, rigid(pose[:3, :3], moved))) > 35.0
