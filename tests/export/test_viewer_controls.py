"""The controls of viewer.html in a browser: the ride with the camera, what a picture shows, notes, files and links."""

import json
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
import torch
from helpers.chromium import in_a_browser
from helpers.classed import classed
from helpers.patience import wait_until
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
from matplotlib import colormaps
from PIL import Image

from drivesplat.export.trained_parts import SampledGroup
from drivesplat.export.viewer import viewer_page
from drivesplat.export.viewer_boxes import BoxMotion
from drivesplat.export.viewer_scene import ViewerContent
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.view import View
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Track
from drivesplat.trajectories.sampled_edit import CameraMotion, Instance, SampledEdit

CONE = "c0ffee9e8b4b4b0f8d6c2a5f1e3d4c5b"


def text_of(name: str) -> str:
    return f'document.getElementById("{name}").textContent'


def value_of(name: str, of: str = "value") -> str:
    return f'document.getElementById("{name}").{of}'


def notes_shown() -> str:
    return '[...document.querySelectorAll(".note")].map((note) => note.textContent)'


def drag(tab, way: int) -> None:
    tab.mouse("mousePressed", 100, 60, button="left", clickCount=1)
    tab.mouse("mouseMoved", 100 + way, 60, button="left", buttons=1)
    tab.mouse("mouseReleased", 100 + way, 60, button="left", clickCount=1)


def inside_the_car() -> CameraMotion:
    """The camera of an edit, in the middle of the car at 1 s."""
    pose = oblique_frame().camera_to_world
    inside = rigid(pose[:3, :3], car_pose(1.0)[:3, 3])
    return CameraMotion(np.array([0.0, 2.0]), np.stack([inside, inside]))


def cone() -> BoxMotion:
    """Something without Gaussians of its own that stands seven metres ahead."""
    pose = oblique_frame().camera_to_world
    place = rigid(np.eye(3), pose[:3, 3] + 7.0 * pose[:3, 2])
    track = Track(CONE, *classed("movable_object.trafficcone"), np.array([1.0, 1.0, 1.0]), np.zeros(0, np.int64),
                  np.zeros(0, np.int64), np.zeros((0, 4, 4)), np.zeros(0, np.int64))  # fmt: skip
    return BoxMotion(track, np.array([0.0, 1.5]), np.stack([place, place]), ((0.0, 1.5),))


def drive_page(*, gaussians: Gaussians | None = None, boxes: tuple[BoxMotion, ...] = ()) -> str:
    """A street with a car, and an edit whose camera is inside it."""
    groups = {"background": SampledGroup(splats(200, 1) if gaussians is None else gaussians), CAR: driving_car()}
    ride = Instance(CAR, CAR, "vehicle.car", np.array([4.0, 4.0, 4.0]), 1.0, None)
    edits = [SampledEdit("inside", (ride,), inside_the_car())]
    content = ViewerContent(groups, a_sky(), False, path_from(oblique_frame()), edits=edits, boxes=boxes)
    return viewer_page(content, "0001 · street", PROVENANCE)


@in_a_browser
def test_the_page_rides_along_until_the_view_is_moved_by_hand_and_again_on_request(opened):
    gaussians = splats(400, sh_degree=1)
    model = a_model(gaussians, None)
    with opened(page_of(gaussians, None)) as tab:
        assert tab.run(text_of("clock")) == "0.00 s" and tab.run(value_of("follow", "checked"))
        assert tab.run(text_of("hint")).startswith("Drag: look") and not tab.run(value_of("hint", "hidden"))
        tab.run(f"{choose('speed', 0.25)}; {click('play')}")
        tab.run(f"""new Promise((done) => {{
          const look = () => {value_of("time")} > 0.3 ? done() : requestAnimationFrame(look);
          look();
        }})""")
        tab.run(click("play"))
        stopped = settled(tab)
        assert tab.run(value_of("hint", "hidden")) and tab.run(value_of("follow", "checked"))
        tab.key("KeyL", "l")
        second = float(parse_qs(urlsplit(tab.run("location.href")).fragment)["second"][0])
        assert psnr(stopped, rendered(model, ridden(second))) > 35.0 > psnr(stopped, rendered(model, ridden(0.0)))
        drag(tab, 3)
        assert tab.run(value_of("follow", "checked")), "a click does not end the ride"
        drag(tab, 30)
        left = settled(tab)
        assert not tab.run(value_of("follow", "checked")) and psnr(left, stopped) < 35.0
        tab.run(set_second(1.5))
        np.testing.assert_array_equal(settled(tab), left)
        for back in (click("follow"), None):
            if back:
                tab.run(back)
            else:
                drag(tab, 30)
                tab.key("KeyR", "r")
            assert psnr(settled(tab), rendered(model, ridden(1.5))) > 40.0


@in_a_browser
def test_the_camera_of_an_edit_is_followed_and_the_page_warns_inside_a_box(opened):
    with opened(drive_page()) as tab:
        tab.run(set_second(1.0))
        settled(tab)
        assert tab.run(notes_shown()) == []
        tab.run(choose("edit", 0))
        settled(tab)
        (note,) = tab.run(notes_shown())
        assert note == f"The camera is inside the box of car {CAR[:8]}."
        drag(tab, 30)
        settled(tab)
        (note,) = tab.run(notes_shown())
        assert note.endswith("Follow the camera of the drive (R) to leave it.")
        tab.run(f"{choose('edit', '')}; {click('follow')}")
        settled(tab)
        assert tab.run(notes_shown()) == []


@in_a_browser
def test_the_time_bar_marks_the_split_and_the_page_says_what_lies_beyond_it(opened):
    places = """[...document.querySelectorAll("#marks span")].map((mark) => {
      const [own, bar] = [mark, mark.parentElement].map((part) => part.getBoundingClientRect());
      return [mark.className, (own.left + (mark.className === "beyond" ? 0 : own.width / 2) - bar.left) / bar.width];
    })"""
    with opened(drive_page()) as tab:
        found = dict(tab.run(places))
        assert found == pytest.approx({"beyond": 0.875, "interpolation": 0.25, "extrapolation": 1.0}, abs=0.01)
        for second, count in ((1.75, 0), (1.8, 1), (1.0, 0), (2.0, 1)):
            tab.run(set_second(second))
            settled(tab)
            notes = tab.run(notes_shown())
            assert len(notes) == count
            assert all("Beyond the last training image (1.75 s)" in note for note in notes)


@in_a_browser
def test_figures_are_shown_on_request(opened):
    with opened(drive_page()) as tab:
        assert tab.run(value_of("figures", "hidden"))
        tab.key("KeyF", "f")
        tab.run(f"""new Promise((done) => {{
          const look = () => {text_of("figures")}.includes("second") ? done() : requestAnimationFrame(look);
          look();
        }})""")
        assert not tab.run(value_of("figures", "hidden")) and tab.run(value_of("figures-on", "checked"))
        figures = tab.run(text_of("figures"))
        assert figures.endswith(" of 212 Gaussians drawn") and " frames a second · " in figures
        assert 0 < int(figures.split("· ")[1].split(" of")[0]) <= 212
        tab.run(click("figures-on"))
        settled(tab)
        assert tab.run(value_of("figures", "hidden"))


def depth_colors(depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Depth in metres by viridis, yellow at 1 m and violet at 100 m, darker where the sky shows through."""
    share = np.clip(np.log(np.maximum(depth, 1e-3)) / np.log(100.0), 0.0, 1.0)
    return colormaps["viridis_r"](share)[..., :3] * alpha[..., None]


@in_a_browser
def test_depths_are_those_of_the_model_in_the_colours_of_range_images(opened):
    gaussians = splats(400, sh_degree=1)
    K = torch.from_numpy(oblique_frame().intrinsics).float()
    K[:2, 2] += 0.5
    K[:2] *= 0.5
    pose = torch.from_numpy(oblique_frame().camera_to_world).float()
    with torch.no_grad():
        picture = a_model(gaussians, None).render(View(K, pose, WIDTH, HEIGHT, 0.0), with_depth=True)
    expected = depth_colors(picture.depth.numpy(), picture.alpha.squeeze().numpy())
    with opened(page_of(gaussians, None)) as tab:
        colour = settled(tab)
        tab.key("KeyV", "v")
        found = settled(tab)
        assert tab.run(value_of("look")) == "depth" and not tab.run(value_of("depths", "hidden"))
        assert psnr(found, expected) > 30.0 > 20.0 > psnr(colour, expected)
        tab.run(choose("look", "colour"))
        np.testing.assert_array_equal(settled(tab), colour)


@in_a_browser
def test_instances_have_one_colour_each_and_the_rest_is_dark_grey(opened):
    with opened(drive_page()) as tab:
        tab.run(set_second(1.0))
        tab.run(choose("look", "instances"))
        found = settled(tab)
        label = np.array(tab.run(f'labelOf({{ id: "{CAR}", samples: [0, 1] }})'))
        other = np.array(tab.run('labelOf({ id: "another", samples: [0, 1] })'))
        assert np.abs(label - other).max() > 0.1 and label.max() > 0.5
        hue, own = found - found.mean(axis=2, keepdims=True), label - label.mean()
        strength = np.linalg.norm(hue, axis=2) / np.linalg.norm(own)
        assert (strength > 0.3).sum() > 100, "where the car is"
        along = (hue @ own / np.linalg.norm(own) ** 2 / np.maximum(strength, 1e-9))[strength > 0.1]
        assert along.min() > 0.98, "no colour but its own"
        tab.run(tick("vehicle.car"))
        grey = settled(tab)
        assert np.ptp(grey, axis=2).max() < 0.02 and 0.05 < grey.max() < 0.6


def downloaded(folder: Path, name: str) -> np.ndarray:
    """The picture that the browser saves there, once it is whole."""
    wait_until((folder / name).is_file)
    return np.asarray(Image.open(folder / name).convert("RGB")) / 255.0


@in_a_browser
def test_a_saved_picture_is_the_shown_one_with_boxes_and_notes(tmp_path, opened):
    folder = tmp_path / "saved"
    folder.mkdir()
    with opened(drive_page()) as tab:
        tab.call("Page.setDownloadBehavior", behavior="allow", downloadPath=str(folder))
        for second, noted in ((1.0, 0), (1.9, 22)):
            tab.run(f"{set_second(second)}; document.getElementById('boxes-on').checked || {click('boxes-on')}")
            shown = settled(tab)
            tab.key("KeyP", "p")
            saved = downloaded(folder, f"0001-street-{second:.2f}s.png")
            assert saved.shape == (HEIGHT, WIDTH, 3)
            above = HEIGHT - noted
            np.testing.assert_allclose(saved[:above], shown[:above], atol=2 / 255)
            assert not noted or np.abs(saved[above:] - shown[above:]).mean() > 0.1, "says that it is not known"


@in_a_browser
def test_a_link_opens_the_same_picture(opened):
    with opened(drive_page(boxes=(cone(),))) as tab:
        tab.run(set_second(0.75))
        tab.key("KeyB", "b")
        drag(tab, 30)
        tab.run(choose("look", "instances"))
        before = settled(tab)
        tab.run(click("link"))
        address = tab.run("location.href")
        tab.open("about:blank", WIDTH, HEIGHT)
        tab.open(address, WIDTH, HEIGHT)
        tab.run(SHOWN_WITHOUT_WORDS)
        np.testing.assert_allclose(settled(tab), before, atol=2 / 255)
        assert tab.run(text_of("clock")) == "0.75 s" and not tab.run(value_of("follow", "checked"))
        tab.run('location.hash = "#second=1.25"')
        tab.wait_for_load()
        tab.run(SHOWN_WITHOUT_WORDS)
        assert tab.run(text_of("clock")) == "1.25 s" and tab.run(value_of("follow", "checked"))


@in_a_browser
def test_boxes_of_objects_with_and_without_gaussians_are_named(opened):
    record = """(() => {
      window.written = new Set();
      const fill = CanvasRenderingContext2D.prototype.fillText;
      CanvasRenderingContext2D.prototype.fillText = function (text, ...at) {
        window.written.add(text);
        return fill.call(this, text, ...at);
      };
    })()"""
    with opened(drive_page(boxes=(cone(),))) as tab:
        tab.run(f"{record}; {set_second(1.0)}")
        plain = settled(tab)
        assert tab.run("[...window.written]") == []
        tab.run(click("boxes-on"))
        boxed = settled(tab)
        names = {f"car {CAR[:8]}", f"trafficcone {CONE[:8]}"}
        assert set(tab.run("[...window.written]")) == names
        changed = np.abs(boxed - plain).max(axis=2) > 0.2
        assert 100 < changed.sum() < changed.size / 2
        tab.run(f"window.written.clear(); {set_second(1.6)}")
        settled(tab)
        assert tab.run("[...window.written]") == [], "both are gone by then"


@in_a_browser
@pytest.mark.parametrize(("width", "height"), [(1280, 720), (390, 844), (844, 390)])
def test_dark_controls_fit_the_window(opened, width, height):
    controls = """(() => {
      const kinds = "#bar button, #bar select, #bar label, #line, #clock, #title, .note";
      const parts = [...document.querySelectorAll(kinds)];
      const shown = parts.filter((part) => part.offsetParent !== null || part.id === "title");
      return shown.map((part) => {
        const { left, top, right, bottom } = part.getBoundingClientRect();
        return { name: part.id || part.textContent, box: [left, top, right, bottom],
          size: parseFloat(getComputedStyle(part).fontSize) };
      });
    })()"""
    with opened(drive_page()) as tab:
        tab.call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        tab.run(set_second(1.9))
        settled(tab)
        if tab.run('getComputedStyle(document.getElementById("more")).display !== "none"'):
            tab.run(click("more"))
        settled(tab)
        found = tab.run(controls)
        assert {"play", "line", "look", "save", "link", "help", "edit"} <= {part["name"] for part in found}
        for part in found:
            left, top, right, bottom = part["box"]
            assert 0 <= left < right <= width and 0 <= top < bottom <= height, part
            assert part["size"] >= 12, part
        for i, one in enumerate(found):
            for other in found[:i]:
                apart = one["box"][0] >= other["box"][2] or other["box"][0] >= one["box"][2]
                apart |= one["box"][1] >= other["box"][3] or other["box"][1] >= one["box"][3]
                assert apart, json.dumps([one, other])
        color = tab.run('getComputedStyle(document.getElementById("play")).backgroundColor')
        assert max(json.loads(color.replace("rgb(", "[").replace(")", "]"))) < 90
        bar = tab.run('document.getElementById("bar").getBoundingClientRect().height')
        assert bar < height / 2
