"""What a user does in viewer.html: choose an edit, compare with recorded images, switch methods, use fingers."""

import base64
import io
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers.chromium import chromium, in_a_browser
from helpers.hand_made import recording_of
from helpers.hand_made_traffic import placed
from helpers.viewer_pages import (
    CAR,
    HEIGHT,
    SHOWN_WITHOUT_WORDS,
    WIDTH,
    a_model,
    a_sky,
    car_pose,
    choose,
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
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.viewer import key_frame_images, viewer_page
from drivesplat.export.viewer_scene import ViewerContent
from drivesplat.model.gaussians import Gaussians, concatenate, recolored
from drivesplat.scene.images import read_image
from drivesplat.scene.rigid import rigid
from drivesplat.trajectories.sampled_edit import CameraMotion, Instance, InstanceMotion, SampledEdit

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
        tab.run(f"{set_second(1.0)}; {choose('edit', 0)}")
        assert psnr(settled(tab), expected()) > 40.0 > 35.0 > psnr(settled(tab), expected(own))
        tab.run(choose("edit", 1))
        twins = own, placed(halved(car.gaussians), beside(1.0))
        assert psnr(settled(tab), expected(*twins)) > 40.0 > 35.0 > psnr(settled(tab), expected(own))
        tab.run('document.getElementById("follow").click()')
        assert psnr(settled(tab), expected(*twins, pose=aside())) > 40.0
        assert tab.run('document.getElementById("followed").textContent') == "edited camera"
        tab.run(f"{tick('twin')}")
        assert psnr(settled(tab), expected(own, pose=aside())) > 40.0
        tab.run(f"{tick('twin')}; {set_second(0.2)}")
        assert psnr(settled(tab), expected(placed(car.gaussians, car_pose(0.2)), pose=aside())) > 40.0, "not there yet"
        tab.run(f"{set_second(1.0)}; {choose('edit', '')}; document.getElementById('follow').click()")
        tab.key("KeyR", "r")
        assert psnr(settled(tab), expected(own)) > 40.0
        tab.run(choose("edit", 2))
        painted = recolored(own, torch.from_numpy(SWAPPED).float(), torch.ones(len(own), dtype=torch.bool))
        assert psnr(settled(tab), expected(painted)) > 40.0 > 35.0 > psnr(settled(tab), expected(own))


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
        tab.run(choose("image", "none"))
        tab.key("KeyR", "r")
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
