"""Renderings against the truth of a tiny world: the figures of simple models can be computed from the PNGs."""

import dataclasses
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch
from helpers.drives import CAMERA_AT, CAMERA_TO_EGO, ORIGIN, World, scene_at, seconds_of, true_depths, write_world
from helpers.hand_made import Own, recording_of, round_gaussians, write_labels
from helpers.hand_made_truth import LEADING, OFFSETS, write_truth
from helpers.records import EMPTY_CHECKPOINT, EMPTY_MASKS
from PIL import Image
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity

from drivesplat.errors import ResultError
from drivesplat.evaluation.evaluate import EvaluationInputs, known_truth, truth_metrics
from drivesplat.evaluation.image_metrics import measure_groups, measured_images
from drivesplat.evaluation.metrics import RegionMetrics, measuring_threads
from drivesplat.evaluation.synthetic import DriveTruth, lateral_metrics, removal_metrics, rendered
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.picture import Picture
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import IMAGE, State, Want
from drivesplat.model.view import View, view_of
from drivesplat.readers.truth import TruthFrame, TruthView, read_truth, truth_image
from drivesplat.scene.regions import LABELS
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame
from drivesplat.scene.tracks import Box, box_at, boxes_at
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.lidar_depth import LidarDepthJob

CPU = torch.device("cpu")
MARGIN = 0.1
GREY = (0.45, 0.5, 0.4)
HOLDOUT = HoldoutSettings(every_nth=4, offset=2, last_block=1)
EGO_ROWS = 12
"""Number of rows at the lower edge of the masks that show the ego vehicle."""
WORLD = World(key_frames=6, width=160, height=90)


@pytest.fixture(scope="module")
def known(tmp_path_factory) -> DriveTruth:
    root = write_world(tmp_path_factory.mktemp("tiny"), WORLD)
    scene = scene_at(root, sweeps=False)
    labels = np.full((90, 160), LABELS["static"], dtype=np.uint8)
    labels[90 - EGO_ROWS :] = LABELS["own_car"]
    masks = write_labels(tmp_path_factory.mktemp("masks"), scene, labels)
    path = write_truth(root, WORLD, scene)
    return DriveTruth.read(path, recording_of(scene, masks, **HOLDOUT.model_dump()))


def flat_model(color=GREY, parts=()) -> SplatModel:
    """No Gaussians but those of `parts`; a sky of one colour."""
    return SplatModel([*parts, round_gaussians([])], ConstantSky(torch.tensor(color), 1e-2)).requires_grad_(False)


def frames_of(known: DriveTruth, view: TruthView) -> list[tuple[Frame, TruthFrame]]:
    return list(zip(known.recording.scene.frames, view.frames, strict=True))


def lateral_frames(known: DriveTruth, left: float) -> list[tuple[Frame, TruthFrame]]:
    """The frames of the lateral view at an offset."""
    (view,) = (view for view in known.truth.lateral("CAM_FRONT") if view.left_m == left)
    return frames_of(known, view)


def pixels_of(known: DriveTruth, name: str) -> np.ndarray:
    return np.asarray(Image.open(known.path.parent / name).convert("RGB")) / 255.0


def rays_meet(box: Box, camera_to_world: np.ndarray, frame: Frame) -> np.ndarray:
    """The pixels (h, w) whose centres' rays meet a box (slabs)."""
    x, y = np.meshgrid(np.arange(frame.width), np.arange(frame.height))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(frame.intrinsics).T @ camera_to_world[:3, :3].T
    turn, middle = box.object_to_world[:3, :3], box.object_to_world[:3, 3]
    start, rays = (camera_to_world[:3, 3] - middle) @ turn, rays @ turn
    a, b = (-box.size / 2 - start) / rays, (box.size / 2 - start) / rays
    enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
    return (enter < leave) & (leave > 0)


def pose_in_scene(known: DriveTruth, truth: TruthFrame) -> np.ndarray:
    pose = np.array(truth.camera_to_global)
    pose[:3, 3] -= known.recording.scene.origin
    return pose


def movable_boxes(known: DriveTruth, frame: Frame) -> list[Box]:
    return [box for box in boxes_at(known.recording.scene, frame.timestamp) if box.object_class.is_dynamic]


def static_pixels(known: DriveTruth, frame: Frame, pose: np.ndarray) -> np.ndarray:
    """The pixels (h, w) outside all boxes of movable objects, as seen from a pose."""
    return ~np.any([rays_meet(box, pose, frame) for box in movable_boxes(known, frame)], axis=0)


def static_masks(known: DriveTruth, left: float) -> list[np.ndarray]:
    frames = lateral_frames(known, left)
    return [static_pixels(known, frame, pose_in_scene(known, truth)) for frame, truth in frames]


def depths_of(known: DriveTruth, left: float) -> list[np.ndarray]:
    """The values of the depth images of a lateral view."""
    return [np.asarray(Image.open(known.path.parent / truth.depth)) for _, truth in lateral_frames(known, left)]


def leading_box(known: DriveTruth, frame: Frame) -> Box:
    track = next(track for track in known.recording.scene.tracks if track.id == known.truth.leading)
    return box_at(track, frame.timestamp, known.recording.scene.key_frame_interval)


def by_hand(color, images: list[np.ndarray], masks: list[np.ndarray]) -> float:
    """The PSNR of a constant colour over the pixels of all frames."""
    errors = np.concatenate([((image - np.array(color)) ** 2)[mask] for image, mask in zip(images, masks, strict=True)])
    return -10.0 * np.log10(errors.mean())


def test_a_constant_colours_lateral_figures_follow_from_the_pngs(known):
    """Of the car ahead, seen from beside the path, count neither the parked truck nor the pedestrian, nor pixels where
    one of them is nearer."""
    lateral_of_grey = lateral_metrics(flat_model(), known, "CAM_FRONT", None, CPU)
    assert list(lateral_of_grey) == [str(left) for left in OFFSETS] == ["2.0", "-2.0", "4.0"]
    everywhere = [np.ones((90, 160), dtype=bool)] * 6
    options = {"data_range": 1.0, "channel_axis": 2, "gaussian_weights": True, "sigma": 1.5}
    for left in OFFSETS:
        found = lateral_of_grey[str(left)]
        assert found.keys() == {"all", "static", "moving_vehicle", "road", "markings", "depth"}
        assert found["road"] is found["markings"] is None, "the class images show the sky alone"
        images, masks = [], []
        for frame, truth in lateral_frames(known, left):
            pose, boxes = pose_in_scene(known, truth), movable_boxes(known, frame)
            distances = [np.linalg.norm(box.object_to_world[:3, 3] - pose[:3, 3]) for box in boxes]
            reached = np.stack([
                np.where(rays_meet(box, pose, frame), distance, np.inf)
                for box, distance in zip(boxes, distances, strict=True)
            ])  # fmt: skip
            car = next(i for i, box in enumerate(boxes) if box.track_id == LEADING)
            masks.append((np.argmin(reached, axis=0) == car) & np.isfinite(reached[car]))
            images.append(pixels_of(known, truth.image))
        assert found["all"]["psnr"] == pytest.approx(by_hand(GREY, images, everywhere), abs=1e-4)
        assert found["all"]["pixels"] == 6 * 90 * 160 and found["all"]["lpips"] is None
        similarity = [
            structural_similarity(
                np.broadcast_to(GREY, image.shape), image, use_sample_covariance=False, full=True, **options
            )[1].mean()
            for image in images
        ]  # fmt: skip
        assert found["all"]["ssim"] == pytest.approx(np.mean(similarity), abs=1e-5)
        assert found["moving_vehicle"]["pixels"] == pytest.approx(sum(mask.sum() for mask in masks), abs=6)
        assert found["moving_vehicle"]["psnr"] == pytest.approx(by_hand(GREY, images, masks), abs=0.02)
        others = [lateral_of_grey[str(other)]["all"]["psnr"] for other in OFFSETS if other != left]
        assert min(abs(found["all"]["psnr"] - psnr) for psnr in others) > 0.01, "the offsets must differ"


class Watched(SplatModel):
    """A flat model that records the requested views."""

    def __init__(self):
        super().__init__([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2))
        self.views: list[View] = []

    def render(self, view: View, *arguments: Any, **options: Any) -> Picture:
        self.views.append(view)
        return super().render(view, *arguments, **options)


def views_by_offset(known: DriveTruth) -> dict[float, list[View]]:
    """The requested views of the lateral offsets, which are rendered in the order of the truth."""
    model = Watched()
    lateral_metrics(model, known, "CAM_FRONT", None, CPU)
    assert len(model.views) == 6 * len(OFFSETS)
    return {left: model.views[6 * i : 6 * i + 6] for i, left in enumerate(OFFSETS)}


def test_lateral_views_are_beside_the_recorded_poses(known):
    """The ego vehicle drives along x, and y is its left; the camera looks forward, and its x axis points to the right.
    With pose errors, of decimetres and degrees, views are relative to the recorded pose."""
    scene, random, frames = known.recording.scene, np.random.default_rng(0), []
    for left, views in views_by_offset(known).items():
        for view, frame in zip(views, scene.frames, strict=True):
            place = ORIGIN + WORLD.ego_at(seconds_of(frame.timestamp)) + CAMERA_AT + [0.0, left, 0.0]
            pose = view.camera_to_world.double().numpy()
            np.testing.assert_allclose(pose[:3, 3] + scene.origin, place, atol=2e-5)
            np.testing.assert_allclose(pose[:3, :3], CAMERA_TO_EGO, atol=1e-6)
            assert view.time == pytest.approx(scene.seconds(frame.timestamp), abs=1e-6)
            assert (view.width, view.height) == (160, 90)
    for frame in scene.frames:
        off = rigid(Rotation.from_rotvec(random.normal(0.0, 0.05, 3)).as_matrix(), random.normal(0.0, 0.3, 3))
        frames.append(dataclasses.replace(frame, camera_to_world=frame.camera_to_world @ off))
    moved = dataclasses.replace(scene, frames=tuple(frames))
    recording = recording_of(moved, known.recording.masks, **HOLDOUT.model_dump())
    nudged = dataclasses.replace(known, recording=recording)
    for left, views in views_by_offset(nudged).items():
        for view, (frame, truth) in zip(views, lateral_frames(nudged, left), strict=True):
            step = np.linalg.inv(frame.camera_to_world) @ view.camera_to_world.double().numpy()
            np.testing.assert_allclose(step, rigid(np.eye(3), np.array([-left, 0.0, 0.0])), atol=2e-5)
            true_pose = pose_in_scene(nudged, truth)
            assert np.abs(view.camera_to_world.numpy() - true_pose).max() > 0.05, "the true view is elsewhere"


class Deep(SplatModel):
    """A flat model with a depth (h, w) of `depth_of` a view."""

    def __init__(self, depth_of: Callable[[View], np.ndarray]):
        super().__init__([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2))
        self._depth_of = depth_of

    def render(self, view: View, *args: Any, **options: Any) -> Picture:
        depth = torch.from_numpy(self._depth_of(view)).float()
        return dataclasses.replace(super().render(view, *args, **options), surface_depth=depth)


def lateral_of_depth(known: DriveTruth, depth_of: Callable[[View], np.ndarray]) -> dict[str, Any]:
    return lateral_metrics(Deep(depth_of), known, "CAM_FRONT", None, CPU)


def left_of(view: View) -> float:
    """The offset at which a view is rendered; the ego vehicle drives along y = 0."""
    return round(float(view.camera_to_world[1, 3]), 3)


@pytest.fixture(scope="module")
def ten_metres_deep(known) -> dict[str, Any]:
    """The lateral figures of a rendering that is 10 m deep everywhere."""
    return lateral_of_depth(known, lambda _: np.full((90, 160), 10.0))


def frame_at(known: DriveTruth, view: View) -> Frame:
    """The recorded frame at the time of a view."""
    scene = known.recording.scene
    return min(scene.frames, key=lambda frame: abs(scene.seconds(frame.timestamp) - view.time))


@pytest.fixture(scope="module")
def cast_depth(known) -> Callable[[View], np.ndarray]:
    """The depth of a view, cast from where it is rendered; inf in the sky."""
    cast = {}

    def depth(view: View) -> np.ndarray:
        left, frame = left_of(view), frame_at(known, view)
        if (left, frame.timestamp) not in cast:
            cast[left, frame.timestamp] = true_depths(dataclasses.replace(WORLD, left=left), frame)[..., 0]
        return cast[left, frame.timestamp]

    return depth


def test_the_depth_error_is_the_median_over_static_pixels_of_known_depth(known, ten_metres_deep):
    """Neither the sky nor what is beyond the 16 bits has a known depth."""
    expected = {}
    for left in OFFSETS:
        values = np.stack(depths_of(known, left))
        assert (values == 0).sum() > 1000 and (values == 65535).sum() > 100
        known_depth = np.stack(static_masks(known, left)) & (values > 0) & (values < 65535)
        metres = values[known_depth] / 256.0
        expected[left] = np.median(np.abs(10.0 - metres) / metres)
        found = ten_metres_deep[str(left)]["depth"]
        assert found.keys() == {"median_relative_error", "pixels"}
        assert found["median_relative_error"] == pytest.approx(expected[left], rel=2e-4)
        assert found["pixels"] == pytest.approx(len(metres), rel=1e-4)
    for left, median in expected.items():
        others = [expected[other] for other in OFFSETS if other != left]
        assert min(abs(other - median) for other in others) > 1e-3 * median, "the offsets must differ"


def with_class_images(known: DriveTruth) -> tuple[DriveTruth, np.ndarray]:
    """The same truth with class images, all alike: rows of road, with a marking, below others; and that image."""
    classes = np.full((90, 160), 7, dtype=np.uint8)
    classes[60:] = 0
    classes[70:75, 20:90] = 14
    Image.fromarray(classes).save(known.path.parent / "classes.png")

    def shown(view: TruthView) -> TruthView:
        frames = tuple(dataclasses.replace(frame, classes="classes.png") for frame in view.frames)
        return dataclasses.replace(view, frames=frames)

    views = tuple(map(shown, known.truth.views))
    numbers = {"0": "road", "7": "sign", "14": "marking"}
    return dataclasses.replace(known, truth=dataclasses.replace(known.truth, classes=numbers, views=views)), classes


def test_road_and_markings_are_static_pixels_by_the_true_class_images(known):
    """From aside and, in held-out images, from the path."""
    classified, classes = with_class_images(known)
    aside = lateral_metrics(flat_model(), classified, "CAM_FRONT", None, CPU)["2.0"]
    images = [pixels_of(known, truth.image) for _, truth in lateral_frames(known, 2.0)]
    for region, numbers in (("road", (0, 14)), ("markings", (14,))):
        masks = [static & np.isin(classes, numbers) for static in static_masks(known, 2.0)]
        assert aside[region]["pixels"] == pytest.approx(np.sum(masks), rel=2e-3)
        assert aside[region]["psnr"] == pytest.approx(by_hand(GREY, images, masks), abs=0.02)
    groups = measure_groups(flat_model(), known.recording, "CAM_FRONT", None, CPU, {}, classified)
    unclassified = measure_groups(flat_model(), known.recording, "CAM_FRONT", None, CPU, {})
    for group, (figures, *_) in groups.items():
        assert figures.keys() - unclassified[group].metrics.keys() == {"road", "markings"}
        held_out = measured_images(known.recording.record, "CAM_FRONT")[group]
        static = [known.recording.labels(index) == LABELS["static"] for index in held_out]
        assert figures["road"]["pixels"] == sum(int((own & (classes != 7)).sum()) for own in static)


def test_moving_pixels_and_the_sky_have_no_part_in_the_depth_error(known, cast_depth):
    """Their depth, 5 m in the sky, is wrong ninefold; that of the rest by a random share."""
    random, spared = np.random.default_rng(0), {left: [] for left in OFFSETS}

    def wrong(view: View) -> np.ndarray:
        pose, depth = view.camera_to_world.double().numpy(), cast_depth(view)
        counts = static_pixels(known, frame_at(known, view), pose) & np.isfinite(depth)
        depth = np.where(np.isfinite(depth), depth, 5.0)
        shares = random.uniform(0.0, 0.2, counts.shape)
        spared[left_of(view)].append(np.where(counts, shares, np.nan)[depth < 255.9])
        return depth * np.where(counts, 1.0 + shares, 10.0)

    figures = lateral_of_depth(known, wrong)
    for left in OFFSETS:
        error, shares = figures[str(left)]["depth"]["median_relative_error"], np.concatenate(spared[left])
        assert error == pytest.approx(np.nanmedian(shares), rel=2e-3)
        assert np.median(np.nan_to_num(shares, nan=9.0)) > 1.05 * error, "other pixels must be many"


def with_views(known: DriveTruth, *views: TruthView) -> DriveTruth:
    return dataclasses.replace(known, truth=dataclasses.replace(known.truth, views=views))


def test_a_smaller_rendering_is_compared_with_resized_truth(known, ten_metres_deep):
    halved = dataclasses.replace(known, recording=recording_of(known.recording.scene, width=80))
    for offset, found in lateral_of_depth(halved, lambda _: np.full((45, 80), 10.0)).items():
        assert found["all"]["pixels"] == 6 * 45 * 80
        whole = ten_metres_deep[offset]["depth"]
        assert found["depth"]["median_relative_error"] == pytest.approx(whole["median_relative_error"], rel=0.1)
        assert found["depth"]["pixels"] == pytest.approx(whole["pixels"] / 4, rel=0.03)


def hulls(known: DriveTruth) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Per key frame: the street without the leading car, and the pixels inside and outside its box (no ego vehicle)."""
    free = np.arange(90)[:, None] < 90 - EGO_ROWS
    for frame, truth in frames_of(known, known.truth.without_leading("CAM_FRONT")):
        inside = rays_meet(leading_box(known, frame), frame.camera_to_world, frame)
        yield pixels_of(known, truth.image), inside & free, ~inside & free


class Riding(Own):
    """A grid of Gaussians that fills the leading car's box and moves with it, as the car's own part if `knows`."""

    def __init__(self, known: DriveTruth, knows: bool):
        axes = [np.linspace(-0.5, 0.5, n) * share for n, share in ((5, 0.95), (4, 0.95), (4, 0.95))]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        frames = known.recording.scene.frames
        boxes = [leading_box(known, frame) for frame in frames]
        purple = round_gaussians(grid * boxes[0].size, 0.3, 0.98, (0.9, 0.1, 0.9))
        super().__init__(purple, boxes[0].track_id if knows else "another")
        self._poses = {
            round(known.recording.scene.seconds(frame.timestamp), 3): torch.from_numpy(box.object_to_world).float()
            for frame, box in zip(frames, boxes, strict=True)
        }

    def state(self, time: float, want: Want = IMAGE) -> State:
        return State((self._poses[round(time, 3)],))

    def sample(self, state: State, want: Want = IMAGE) -> Gaussians:
        (pose,), still = state.now, super().sample(state, want)
        return dataclasses.replace(still, means=still.means @ pose[:3, :3].T + pose[:3, 3])


def unremoved(model: SplatModel, known: DriveTruth) -> dict[str, Any]:
    """The model with the car against the street without it."""
    metrics = RegionMetrics(None, ("box", "outside"))
    for number, (image, inside, outside) in enumerate(hulls(known)):
        view = view_of(known.recording.record, number, CPU)
        metrics.add(metrics.measure(rendered(model, view), image, {"box": inside, "outside": outside}))
    return metrics.summary()


def test_removing_a_car_equals_a_model_without_it_whose_psnr_follows_from_the_pngs(known):
    """For removal by box and by part; figures improve on those of the same pixels of the unedited model."""
    images, inside, outside = (list(items) for items in zip(*hulls(known), strict=True))
    never = removal_metrics(flat_model(), known, "CAM_FRONT", MARGIN, None, CPU)
    assert never.keys() == {"box", "outside", "not_removed"}
    for region, masks in (("box", inside), ("outside", outside)):
        assert never[region]["pixels"] == pytest.approx(sum(mask.sum() for mask in masks), abs=6)
        assert never[region]["psnr"] == pytest.approx(by_hand(GREY, images, masks), abs=0.02)
    assert never["box"]["pixels"] > 1000
    assert never["box"]["pixels"] + never["outside"]["pixels"] == 6 * 160 * (90 - EGO_ROWS)
    for knows in (False, True):
        model = flat_model(parts=[Riding(known, knows)])
        removed, unedited = removal_metrics(model, known, "CAM_FRONT", MARGIN, None, CPU), unremoved(model, known)
        before = removed["not_removed"]
        assert before.keys() == {"box", "outside"}
        for region in ("box", "outside"):
            assert removed[region]["psnr"] == pytest.approx(never[region]["psnr"], abs=1e-6)
            assert removed[region]["ssim"] == pytest.approx(never[region]["ssim"], abs=1e-6)
            assert before[region]["pixels"] == removed[region]["pixels"]
            assert before[region]["psnr"] == pytest.approx(unedited[region]["psnr"], abs=0.02)
            assert before[region]["ssim"] == pytest.approx(unedited[region]["ssim"], abs=1e-3)
        assert before["box"]["psnr"] < removed["box"]["psnr"] - 3.0


def test_a_recorded_drive_is_not_compared_with_ground_truth(known):
    """Its job has no removal, and a truth.json beside its tables is ignored."""
    spacing = {"own_car_radius": 2.5, "ray_spacing": (0.33, 1.33), "box_margin": 0.2}
    lidar = LidarDepthJob(holdout=HOLDOUT, images=ImageSettings(), **spacing)
    cameras = {"eval_camera": "CAM_FRONT", "cameras": ("CAM_FRONT", "CAM_BACK")}
    job = EvaluateJob(**cameras, sweeps=False, holdout=HOLDOUT, lpips=False, lidar=lidar, removal=None)
    inputs = EvaluationInputs(EMPTY_CHECKPOINT, {}, known.recording, EMPTY_MASKS, lpips_record=None, truth=known.path)
    truth = known_truth(inputs, job)
    assert truth is None and truth_metrics(flat_model(), truth, inputs, job, None, CPU) == {}


def test_figures_need_the_recorded_poses_and_a_leading_car(known):
    lateral = known.truth.lateral("CAM_FRONT")
    assert lateral_metrics(flat_model(), with_views(known, *lateral), "CAM_FRONT", None, CPU) is None
    alone = with_views(known, known.truth.recorded("CAM_FRONT"), lateral[0])
    alone = dataclasses.replace(alone, truth=dataclasses.replace(alone.truth, leading=None))
    assert removal_metrics(flat_model(), alone, "CAM_FRONT", MARGIN, None, CPU) is None
    assert lateral_metrics(flat_model(), alone, "CAM_FRONT", None, CPU)["2.0"]["all"]["pixels"] == 6 * 90 * 160


def damaged(content: dict[str, Any]) -> dict[str, str]:
    """truth.json, spoilt in many ways."""
    view = content["views"][0]

    def without(name: str) -> dict[str, Any]:
        return {key: value for key, value in content.items() if key != name}

    changed = {
        "of another schema": {**content, "schema": 1},
        "without schema": without("schema"),
        "without views": without("views"),
        "with a foreign field": {**content, "colour": "red"},
        "without frames": {**content, "views": [{**view, "frames": None}]},
        "with frames by name": {**content, "views": [{**view, "frames": {"0": view["frames"][0]}}]},
        "with a short frame": {**content, "views": [{**view, "frames": [{"token": "a"}]}]},
        "with a foreign field of a view": {**content, "views": [{**view, "colour": "red"}]},
        "a list": [],
        "a word": "truth",
        "null": None,
    }
    texts = {how: json.dumps(value) for how, value in changed.items()}
    return {**texts, "empty": "", "truncated": json.dumps(content)[:-40]}


def test_an_invalid_or_missing_truth_file_is_refused_naming_file_and_rule(known, tmp_path):
    path = tmp_path / "truth.json"
    for how, text in damaged(json.loads(known.path.read_text())).items():
        path.write_text(text)
        with pytest.raises(ResultError) as refusal:
            read_truth(path)
        assert str(path) in str(refusal.value) and "demo_world" in str(refusal.value), how
    with pytest.raises(ResultError, match=r"nowhere/truth\.json.*demo_world"):
        read_truth(tmp_path / "nowhere" / "truth.json")


def test_a_missing_ground_truth_image_is_named_with_its_rule(known):
    assert truth_image(known.path, lateral_frames(known, 2.0)[0][1].image).is_file()
    views = [
        dataclasses.replace(view, frames=tuple(dataclasses.replace(f, image="lateral/9999.png") for f in view.frames))
        for view in known.truth.views
    ]
    with pytest.raises(ResultError, match=r"lateral/9999\.png.*demo_world"):
        lateral_metrics(flat_model(), with_views(known, *views), "CAM_FRONT", None, CPU)


def test_figures_are_bit_identical_for_any_number_of_threads(known):
    before, found = torch.get_num_threads(), []
    views = known.truth.recorded("CAM_FRONT"), known.truth.lateral("CAM_FRONT")[0]
    some, model = with_views(known, *views), flat_model(parts=[Riding(known, True)])
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            assert measuring_threads() == threads
            lateral = lateral_metrics(model, some, "CAM_FRONT", None, CPU)
            found.append((lateral, removal_metrics(model, known, "CAM_FRONT", MARGIN, None, CPU)))
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1] and all(figures is not None for figures in found[0])
