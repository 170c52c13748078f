"""The ghost panel and the figure of a removal: images, figures and drawing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import Own, recording_of, round_gaussians, write_labels
from matplotlib.figure import Figure
from PIL import Image
from skimage.metrics import peak_signal_noise_ratio

from drivesplat.errors import ResultError
from drivesplat.evaluation.published_fixes import PUBLISHED_FIXES
from drivesplat.model.part import Part
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.regions import LABELS
from drivesplat.scene.scene import Scene
from drivesplat.settings.visuals import GhostSettings, PanelJob, RemovalJob, RemovalSettings, SubjectSettings
from drivesplat.visuals.drawing import draw_panel, draw_removal
from drivesplat.visuals.figures import save_figure
from drivesplat.visuals.ghost_panel import GhostPanel, ghost_panel
from drivesplat.visuals.removal import RemovalPair, remove_actor
from drivesplat.visuals.rendered_view import ModelWithRecording

SKY = torch.tensor([0.3, 0.5, 0.8])
HELD_OUT = 2
"""A key frame of the group interpolation."""
GHOST_AT = np.array([8.6, 1.2, 0.9])
"""Where the car was: 3.04 m before the camera at key frame HELD_OUT, 1.2 m nearer than the car is."""
EGO_FROM_ROW = 44
"""The first image row that the ego vehicle's body covers; it also covers the lower rows of the other car's box."""
ROAD_AT = np.array([9.0, -2.5, 0.5])
"""Beside the car's path."""


@pytest.fixture(scope="module")
def moving(one_car) -> Scene:
    return one_car(6.0, 6.0, 0.4)


def drive_of(
    scene: Scene, masks: Path | None, *parts: Part, places=(GHOST_AT, ROAD_AT), colors=(0.9, 0.1, 0.1)
) -> ModelWithRecording:
    """A background of Gaussians at `places`, and `parts`. Every fourth key frame, from HELD_OUT on, is held out."""
    model = SplatModel([round_gaussians(places, 0.1, 0.6, colors), *parts], ConstantSky(SKY, 1e-2))
    recording = recording_of(scene, masks, every_nth=4, offset=HELD_OUT)
    return ModelWithRecording(model.requires_grad_(False), recording, torch.device("cpu"))


@pytest.fixture(scope="module")
def masks(tiny_scene, tmp_path_factory) -> Path:
    """Label images, the same for every frame: the upper rows left out, the lowest the ego vehicle's body, static."""
    labels = np.full((54, 96), LABELS["static"], dtype=np.uint8)
    labels[:10], labels[EGO_FROM_ROW:] = LABELS["left_out"], LABELS["own_car"]
    return write_labels(tmp_path_factory.mktemp("masks"), tiny_scene, labels)


@pytest.fixture(scope="module")
def panel_of_car(moving, masks) -> tuple[GhostPanel, dict[str, Any], ModelWithRecording]:
    drive = drive_of(moving, masks)
    return *ghost_panel(drive, job_of()), drive


def near_face(key_frame: int) -> np.ndarray:
    """The corners (2, 2) of the car's rear face in the image. The camera looks along x, between the car's sides and at
    a height between floor and roof, so that it hides the rest: both numbers are closed forms of the tiny drive."""
    seconds = 0.5 * key_frame - 0.035
    ahead = (6.0 + 6.0 * seconds - 2.0) - (4.0 * seconds + 1.7)
    focal = 0.62 * 96
    x, y = 48.0 - focal * np.array([1.4, -0.6]) / ahead, 27.0 - focal * (np.array([1.6, 0.0]) - 1.5) / ahead
    return np.stack([x, y], axis=1)


def test_the_outline_is_the_box_in_the_image_and_psnr_of_it_and_of_static_pixels_equal_skimage(panel_of_car):
    panel, record, _ = panel_of_car
    found = np.stack([panel.outline.min(axis=0), panel.outline.max(axis=0)])
    np.testing.assert_allclose(found, near_face(HELD_OUT), atol=1e-3)
    static, box = np.zeros((2, 54, 96), dtype=bool)
    static[10:EGO_FROM_ROW] = True
    (left, top), (right, bottom) = np.ceil(near_face(HELD_OUT) - 0.5).astype(int)
    box[top:EGO_FROM_ROW, left:right] = True
    assert bottom > EGO_FROM_ROW and record["subject"]["pixels"] == box.sum()
    for name, pixels in (("static", static), ("vehicle", box)):
        expected = peak_signal_noise_ratio(panel.truth[pixels], panel.render[pixels], data_range=1.0)
        assert record[name]["psnr"] == pytest.approx(expected) and record[name]["pixels"] == pixels.sum()


def job_of(key_frame: int | None = HELD_OUT) -> PanelJob:
    return PanelJob(eval_camera="CAM_FRONT", subject=SubjectSettings(key_frame=key_frame), ghosts=GhostSettings())


def seen_at(drive: ModelWithRecording, key_frame: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Continuous pixels (n, 2) of world points and their depths, by the camera's matrix."""
    frame = drive.recording.scene.frames[2 * key_frame]
    in_camera = np.column_stack([points, np.ones(len(points))]) @ np.linalg.inv(frame.camera_to_world).T
    pixels = in_camera[:, :3] @ frame.intrinsics.T
    return pixels[:, :2] / pixels[:, 2:] + 0.5, in_camera[:, 2]


def near(pixel: np.ndarray, radius: float) -> np.ndarray:
    x, y = np.meshgrid(np.arange(96) + 0.5, np.arange(54) + 0.5)
    return np.hypot(x - pixel[0], y - pixel[1]) < radius


def test_the_path_is_that_of_the_box_centre_on_the_ground(panel_of_car):
    """From x = 4.5 to 34.5 at y = 0.4 on the road, as far as it is half a metre before the camera."""
    panel, _, drive = panel_of_car
    x = np.arange(4.5, 34.5, 0.001)
    line, depth = seen_at(drive, HELD_OUT, np.stack([x, np.full_like(x, 0.4), np.zeros_like(x)], axis=1))
    line = line[depth > 0.5]
    path = panel.path[np.isfinite(panel.path).all(axis=1)]
    away = np.abs(path[:, None] - line[None]).max(axis=2).min(axis=1)
    assert (away < 0.2).all()
    assert np.abs(path[-1] - line[-1]).max() < 0.5
    assert path[0, 1] > 54, "it starts below the lower border of the image"
    assert (np.diff(path[:, 1]) < 0).all(), "it leads away from the camera"


def pale(truth: np.ndarray) -> np.ndarray:
    """Greys from 0.45 for black to 0.95 for the brightest two percent."""
    grey = truth.mean(axis=2)[..., None].repeat(3, axis=2)
    return np.interp(grey, [0.0, np.quantile(grey, 0.98)], [0.45, 0.95])


def test_the_ghost_image_is_the_pale_image_except_for_the_ghost(panel_of_car):
    panel, record, drive = panel_of_car
    pixel = seen_at(drive, HELD_OUT, GHOST_AT[None])[0][0]
    changed = (np.abs(panel.ghosts - pale(panel.truth)) > 1e-6).any(axis=2)
    assert record["ghosts"]["gaussians"] == 1
    assert near(pixel, 3.0).sum() > 20
    assert changed[near(pixel, 3.0)].all() and not changed[~near(pixel, 9.0)].any()
    road = seen_at(drive, HELD_OUT, ROAD_AT[None])[0][0]
    assert (np.abs(panel.render - SKY.numpy()).max(axis=2) > 0.05)[near(road, 1.5)].all(), (
        "the other Gaussian is rendered"
    )
    assert near(road, 1.5).any() and not changed[near(road, 1.5)].any(), "and is not a ghost"


@pytest.fixture(scope="module")
def still(one_car, masks) -> tuple[GhostPanel, dict[str, Any]]:
    return ghost_panel(drive_of(one_car(0.0, 6.0, 0.4), masks), job_of(None))


def test_without_a_moving_vehicle_the_middle_key_frame_is_shown_and_figures_are_null(still, panel_of_car, tiny_scene):
    panel, record = still
    recorded = np.asarray(Image.open(tiny_scene.frames[10].image_path).convert("RGB"))
    np.testing.assert_allclose(panel.truth * 255.0, recorded)
    np.testing.assert_allclose(panel.ghosts, pale(panel.truth))
    assert len(panel.outline) == len(panel.path) == 0
    assert record["key_frame"] == 5 and record["static"]["psnr"] > 0
    assert record["subject"] is None and record["vehicle"] is None and record["ghosts"] is None
    assert record["why_null"] == "no moving vehicle is visible from CAM_FRONT in this scene"
    json.dumps(record, allow_nan=False)
    assert record.keys() == panel_of_car[1].keys()


def titles(figure: Figure) -> list[str]:
    return [axis.get_title(loc="left") for axis in figure.axes]


def shown(figure: Figure, count: int) -> list[np.ndarray]:
    return [np.asarray(axis.images[0].get_array()) for axis in figure.axes[:count]]


def test_the_four_images_are_drawn_with_outline_path_and_published_fixes(panel_of_car):
    """Truth, rendering, error and ghosts. matplotlib's pixel centres are integers, the panel's are halves."""
    panel, record, _ = panel_of_car
    figure = draw_panel(panel, record, "vanilla")
    error = np.abs(panel.render - panel.truth).mean(axis=2)
    for found, expected in zip(shown(figure, 4), (panel.truth, panel.render, error, panel.ghosts), strict=True):
        np.testing.assert_allclose(found, expected)
    for axis in figure.axes:
        (polygon,) = axis.patches
        np.testing.assert_allclose(polygon.get_xy()[:-1], panel.outline - 0.5, atol=1e-6)
    (line,) = figure.axes[3].lines
    drawn = line.get_xydata()
    inside = ((panel.path >= 0) & (panel.path <= [96, 54])).all(axis=1)
    np.testing.assert_allclose(drawn[inside], panel.path[inside] - 0.5)
    assert np.isnan(drawn[~inside]).all() and inside.any() and not inside.all()
    text = figure.get_supxlabel()
    assert "docs/ghosts.md" in text and all(f"{fix.method}: {fix.adds}" in text for fix in PUBLISHED_FIXES)
    figure.canvas.draw()
    below = figure._supxlabel.get_window_extent()
    assert below.x1 < figure.bbox.x1, "it fits into the figure"
    assert all(below.y1 <= axis.get_window_extent().y0 for axis in figure.axes[:4])


def test_a_training_image_and_an_image_without_ghosts_are_named_in_titles(moving, masks):
    panel, record = ghost_panel(drive_of(moving, masks, places=[ROAD_AT]), job_of(3))
    figure = draw_panel(panel, record, "vanilla")
    assert "(training image)" in figure.get_suptitle() and titles(figure)[3].startswith("Ghosts: none")


def removal(scene: Scene, *parts: Part) -> tuple[RemovalPair, dict[str, Any]]:
    job = RemovalJob(
        eval_camera="CAM_FRONT",
        subject=SubjectSettings(key_frame=0),
        ghosts=GhostSettings(),
        removal=RemovalSettings(),
    )
    return remove_actor(drive_of(scene, None, *parts, places=[[7.0, 0.4, 0.8], ROAD_AT]), job)


def test_a_removal_is_drawn_with_without_and_difference(moving):
    pair, record = removal(moving)
    figure = draw_removal(pair, record, "street")
    assert titles(figure)[:2] == ["Rendering", "Without the Gaussians in the box"]
    assert titles(figure)[2].startswith("Absolute difference")
    difference = np.abs(pair.with_car - pair.without_car).mean(axis=2)
    for found, expected in zip(shown(figure, 3), (pair.with_car, pair.without_car, difference), strict=True):
        np.testing.assert_allclose(found, expected)
    assert difference.max() > 0.01 and 0.01 < record["box"]["changed_share"] < 0.5
    said = f"1 Gaussians removed: the vehicle is still there, {record['box']['changed_share']:.0%} of the pixel"
    assert "street" in figure.get_suptitle() and said in figure.get_suptitle()


def test_titles_of_a_removal_say_whose_gaussians_are_removed_and_whether_the_vehicle_is_gone(moving):
    pair, record = removal(moving, Own(round_gaussians([[7.0, 0.4, 0.8]]), "it"))
    assert record["removed_by"] == "actor"
    gone = "the vehicle is gone, 91% of the pixels of the box changed, "
    still_there = "the vehicle is still there, 7% of the pixels of the box changed (gone: 50% or more)"
    for changed, holes, verdict in (
        (0.07, 0.0, still_there), (0.91, 0.17, f"{gone}holes in 17% of the box"), (0.91, 0.0, f"{gone}no holes"),
    ):  # fmt: skip
        record |= {"box": {"changed_share": changed}, "holes": {"share_of_box": holes}}
        figure = draw_removal(pair, record, "street")
        assert figure.get_suptitle().endswith(verdict)
        assert titles(figure)[1] == "Without the vehicle's Gaussians"


def test_saved_figures_are_landscape_pngs_1600_pixels_wide(still, moving, tmp_path):
    figures = {
        "still.png": draw_panel(*still, "vanilla"),
        "removal.png": draw_removal(*removal(moving), "vanilla"),
    }
    for name, figure in figures.items():
        save_figure(tmp_path / name, figure)
        with Image.open(tmp_path / name) as image:
            assert image.format == "PNG" and image.width == 1600 and image.height < image.width
            pixels = np.asarray(image.convert("RGB"))
        assert pixels.std() > 10, "it is not blank"
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(figures)


def test_a_failed_write_keeps_the_previous_figure(still, tmp_path, monkeypatch):
    path = tmp_path / "panel.png"
    path.write_bytes(b"older")

    def full(self, file, **_):
        file.write(b"half a pic")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    with pytest.raises(ResultError, match="No space left on device") as refusal:
        save_figure(path, draw_panel(*still, "vanilla"))
    assert str(path) in str(refusal.value)
    assert path.read_bytes() == b"older" and list(tmp_path.iterdir()) == [path]
