"""Renderings against the truth of a tiny world: the figures of simple models can be computed from the PNGs."""

import dataclasses
import functools
import json
from collections.abc import Callable, Iterator
from pathlib import Path
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
from drivesplat.evaluation.evaluate import EvaluationInputs, truth_metrics
from drivesplat.evaluation.metrics import RegionMetrics, measuring_threads
from drivesplat.evaluation.synthetic import DriveTruth, lateral_metrics, removal_metrics, rendered
from drivesplat.model.background import Background
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
from drivesplat.settings.visuals import RemovalSettings

CPU = torch.device("cpu")
MARGIN = 0.1
GREY = (0.45, 0.5, 0.4)
HOLDOUT = HoldoutSettings(every_nth=4, offset=2, last_block=1)
LIDAR = LidarDepthJob(
    holdout=HOLDOUT, images=ImageSettings(), own_car_radius=2.5, ray_spacing=(0.33, 1.33),
    box_margin=0.2,
)  # fmt: skip
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


@pytest.fixture(scope="module")
def lateral_of_grey(known) -> dict[str, Any]:
    """The lateral figures of one colour."""
    return lateral_metrics(flat_model(), known, "CAM_FRONT", None, CPU)


@pytest.fixture(scope="module")
def removal_of_grey(known) -> dict[str, Any]:
    """The removal figures of one colour."""
    return removal_metrics(flat_model(), known, "CAM_FRONT", MARGIN, None, CPU)


def purple(places) -> Background:
    return round_gaussians(places, 0.3, 0.98, (0.9, 0.1, 0.9))


def frames_of(known: DriveTruth, view: TruthView) -> list[tuple[Frame, TruthFrame]]:
    return list(zip(known.recording.scene.frames, view.frames, strict=True))


def front_frames(known: DriveTruth) -> list[tuple[Frame, TruthFrame]]:
    return frames_of(known, known.truth.recorded("CAM_FRONT"))


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


@pytest.mark.parametrize("left", OFFSETS)
def test_a_constant_colours_lateral_psnr_follows_from_the_pngs(known, lateral_of_grey, left):
    result = lateral_of_grey
    assert list(result) == ["2.0", "-2.0", "4.0"]
    found = result[str(left)]
    assert found.keys() == {"all", "static", "moving_vehicle", "depth"}
    images = [pixels_of(known, truth.image) for _, truth in lateral_frames(known, left)]
    everywhere = [np.ones((90, 160), dtype=bool)] * 6
    assert found["all"]["psnr"] == pytest.approx(by_hand(GREY, images, everywhere), abs=1e-4)
    assert found["all"]["pixels"] == 6 * 90 * 160
    similarity = [
        structural_similarity(
            np.broadcast_to(GREY, image.shape), image, data_range=1.0, channel_axis=2, gaussian_weights=True,
            sigma=1.5, use_sample_covariance=False, full=True,
        )[1].mean()
        for image in images
    ]  # fmt: skip
    assert found["all"]["ssim"] == pytest.approx(np.mean(similarity), abs=1e-5)
    assert found["all"]["lpips"] is None
    others = [result[str(other)]["all"]["psnr"] for other in OFFSETS if other != left]
    assert min(abs(found["all"]["psnr"] - psnr) for psnr in others) > 0.01, "the offsets must differ"


@pytest.mark.parametrize("left", OFFSETS)
def test_pixels_of_moving_vehicles_are_those_of_the_car_ahead_seen_from_beside_the_path(known, lateral_of_grey, left):
    """Neither the parked truck nor the pedestrian counts, nor pixels where one of them is nearer."""
    images, masks = [], []
    for frame, truth in lateral_frames(known, left):
        pose, boxes = pose_in_scene(known, truth), movable_boxes(known, frame)
        distances = [np.linalg.norm(box.object_to_world[:3, 3] - pose[:3, 3]) for box in boxes]
        reached = [
            np.where(rays_meet(box, pose, frame), distance, np.inf)
            for box, distance in zip(boxes, distances, strict=True)
        ]
        car = next(i for i, box in enumerate(boxes) if box.track_id == LEADING)
        masks.append((np.argmin(reached, axis=0) == car) & np.isfinite(reached[car]))
        images.append(pixels_of(known, truth.image))
    result = lateral_of_grey[str(left)]["moving_vehicle"]
    assert result["pixels"] == pytest.approx(sum(mask.sum() for mask in masks), abs=6)
    assert result["psnr"] == pytest.approx(by_hand(GREY, images, masks), abs=0.02)


class Watched(SplatModel):
    """A flat model that records the requested views."""

    def __init__(self):
        super().__init__([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2))
        self.views: list[View] = []

    def render(self, view: View, *arguments: Any, **options: Any) -> Picture:
        self.views.append(view)
        return super().render(view, *arguments, **options)


def views_by_offset(model: Watched) -> dict[float, list[View]]:
    """The requested views of the lateral offsets, which are rendered in the order of the truth."""
    assert len(model.views) == 6 * len(OFFSETS)
    return {left: model.views[6 * i : 6 * i + 6] for i, left in enumerate(OFFSETS)}


@pytest.mark.parametrize("left", OFFSETS)
def test_lateral_views_are_at_their_offset_to_the_left_of_the_ego_vehicle(known, left):
    """The ego vehicle drives along x; y is its left."""
    model = Watched()
    lateral_metrics(model, known, "CAM_FRONT", None, CPU)
    for view, frame in zip(views_by_offset(model)[left], known.recording.scene.frames, strict=True):
        place = ORIGIN + WORLD.ego_at(seconds_of(frame.timestamp)) + CAMERA_AT + [0.0, left, 0.0]
        pose = view.camera_to_world.double().numpy()
        np.testing.assert_allclose(pose[:3, 3] + known.recording.scene.origin, place, atol=2e-5)
        np.testing.assert_allclose(pose[:3, :3], CAMERA_TO_EGO, atol=1e-6)
        assert view.time == pytest.approx(known.recording.scene.seconds(frame.timestamp), abs=1e-6)
        assert (view.width, view.height) == (160, 90)


def nudged(known: DriveTruth, seed: int) -> DriveTruth:
    """The same truth, with a different error of decimetres and degrees in each recorded pose."""
    random = np.random.default_rng(seed)
    frames = []
    for frame in known.recording.scene.frames:
        off = rigid(Rotation.from_rotvec(random.normal(0.0, 0.05, 3)).as_matrix(), random.normal(0.0, 0.3, 3))
        frames.append(dataclasses.replace(frame, camera_to_world=frame.camera_to_world @ off))
    scene = dataclasses.replace(known.recording.scene, frames=tuple(frames))
    return dataclasses.replace(known, recording=recording_of(scene, known.recording.masks, **HOLDOUT.model_dump()))


@pytest.mark.parametrize("seed", range(3))
def test_with_pose_errors_lateral_views_are_relative_to_the_recorded_pose(known, seed):
    """The camera looks forward; its x axis points to the right."""
    model, off = Watched(), nudged(known, seed)
    lateral_metrics(model, off, "CAM_FRONT", None, CPU)
    for left, views in views_by_offset(model).items():
        for view, (frame, truth) in zip(views, lateral_frames(off, left), strict=True):
            step = np.linalg.inv(frame.camera_to_world) @ view.camera_to_world.double().numpy()
            np.testing.assert_allclose(step, rigid(np.eye(3), np.array([-left, 0.0, 0.0])), atol=2e-5)
            true_pose = pose_in_scene(off, truth)
            assert np.abs(view.camera_to_world.numpy() - true_pose).max() > 0.05, "the true view is elsewhere"


class Deep(SplatModel):
    """A flat model with a depth (h, w) of `depth_of` a view."""

    def __init__(self, depth_of: Callable[[View], np.ndarray]):
        super().__init__([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2))
        self._depth_of = depth_of

    def render(self, view: View, *args: Any, **options: Any) -> Picture:
        depth = torch.from_numpy(self._depth_of(view)).float()
        return dataclasses.replace(super().render(view, *args, **options), surface_depth=depth)


def depth_figures(known: DriveTruth, depth_of: Callable[[View], np.ndarray]) -> dict[float, dict[str, Any] | None]:
    """By offset."""
    found = lateral_metrics(Deep(depth_of), known, "CAM_FRONT", None, CPU)
    return {left: found[str(left)]["depth"] for left in OFFSETS}


def left_of(view: View) -> float:
    """The offset at which a view is rendered; the ego vehicle drives along y = 0."""
    return round(float(view.camera_to_world[1, 3]), 3)


@pytest.fixture(scope="module")
def cast_depth(known) -> Callable[[View], np.ndarray]:
    """The depth of a view, cast from where it is rendered; inf in the sky."""
    scene = known.recording.scene

    @functools.cache
    def cast_from(left: float, number: int) -> np.ndarray:
        return true_depths(dataclasses.replace(WORLD, left=left), scene.frames[number])[..., 0]

    def depth(view: View) -> np.ndarray:
        away = [abs(scene.seconds(frame.timestamp) - view.time) for frame in scene.frames]
        return cast_from(left_of(view), int(np.argmin(away)))

    return depth


@pytest.fixture(scope="module")
def true_depth(cast_depth) -> Callable[[View], np.ndarray]:
    """The same, with 5 m in the sky."""
    return lambda view: np.where(np.isfinite(cast_depth(view)), cast_depth(view), 5.0)


def test_the_depth_error_is_the_median_over_static_pixels_of_known_depth(known):
    """A rendering that is 10 m deep everywhere. Neither the sky nor what is beyond the 16 bits has a known depth."""

    all_found, expected = depth_figures(known, lambda _: np.full((90, 160), 10.0)), {}
    for left in OFFSETS:
        values = np.stack(depths_of(known, left))
        assert (values == 0).sum() > 1000 and (values == 65535).sum() > 100
        known_depth = np.stack(static_masks(known, left)) & (values > 0) & (values < 65535)
        metres = values[known_depth] / 256.0
        expected[left] = np.median(np.abs(10.0 - metres) / metres)
        found = all_found[left]
        assert found.keys() == {"median_relative_error", "pixels"}
        assert found["median_relative_error"] == pytest.approx(expected[left], rel=2e-4)
        assert found["pixels"] == pytest.approx(len(metres), rel=1e-4)
    for left, median in expected.items():
        others = [expected[other] for other in OFFSETS if other != left]
        assert min(abs(other - median) for other in others) > 1e-3 * median, "the offsets must differ"


def test_moving_pixels_and_the_sky_have_no_part_in_the_depth_error(known, cast_depth, true_depth):
    """Their depth is wrong ninefold; that of the rest by a random share."""
    random, spared = np.random.default_rng(0), {left: [] for left in OFFSETS}
    frames = known.recording.scene.frames

    def wrong(view: View) -> np.ndarray:
        pose = view.camera_to_world.double().numpy()
        frame = min(frames, key=lambda frame: abs(known.recording.scene.seconds(frame.timestamp) - view.time))
        counts = static_pixels(known, frame, pose) & np.isfinite(cast_depth(view))
        shares = random.uniform(0.0, 0.2, counts.shape)
        spared[left_of(view)].append(np.where(counts, shares, np.nan)[true_depth(view) < 255.9])
        return true_depth(view) * np.where(counts, 1.0 + shares, 10.0)

    for left, found in depth_figures(known, wrong).items():
        error, shares = found["median_relative_error"], np.concatenate(spared[left])
        assert error == pytest.approx(np.nanmedian(shares), rel=2e-3)
        everywhere = np.median(np.nan_to_num(shares, nan=9.0))
        assert everywhere > 1.05 * error, "other pixels must be many"


def with_views(known: DriveTruth, *views: TruthView) -> DriveTruth:
    return dataclasses.replace(known, truth=dataclasses.replace(known.truth, views=views))


def test_a_smaller_rendering_is_compared_with_resized_truth(known):
    halved = dataclasses.replace(known, recording=recording_of(known.recording.scene, width=80))
    small = lateral_metrics(Deep(lambda _: np.full((45, 80), 10.0)), halved, "CAM_FRONT", None, CPU)
    large = lateral_metrics(Deep(lambda _: np.full((90, 160), 10.0)), known, "CAM_FRONT", None, CPU)
    for offset, found in small.items():
        assert found["all"]["pixels"] == 6 * 45 * 80
        whole = large[offset]["depth"]
        assert found["depth"]["median_relative_error"] == pytest.approx(whole["median_relative_error"], rel=0.1)
        assert found["depth"]["pixels"] == pytest.approx(whole["pixels"] / 4, rel=0.03)


def test_without_the_recorded_poses_there_are_no_lateral_figures(known):
    alone = with_views(known, *known.truth.lateral("CAM_FRONT"))
    assert lateral_metrics(flat_model(), alone, "CAM_FRONT", None, CPU) is None


def hulls(known: DriveTruth) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Per key frame: the street without the leading car, and the pixels inside and outside its box (no ego vehicle)."""
    free = np.arange(90)[:, None] < 90 - EGO_ROWS
    for frame, truth in frames_of(known, known.truth.without_leading("CAM_FRONT")):
        inside = rays_meet(leading_box(known, frame), frame.camera_to_world, frame)
        yield pixels_of(known, truth.image), inside & free, ~inside & free


def test_a_constant_colours_removal_psnr_follows_from_the_pngs(known, removal_of_grey):
    images, inside, outside = (list(items) for items in zip(*hulls(known), strict=True))
    result = removal_of_grey
    assert result.keys() == {"box", "outside", "not_removed"}
    for region, masks in (("box", inside), ("outside", outside)):
        assert result[region]["pixels"] == pytest.approx(sum(mask.sum() for mask in masks), abs=6)
        assert result[region]["psnr"] == pytest.approx(by_hand(GREY, images, masks), abs=0.02)
    assert result["box"]["pixels"] > 1000
    assert result["box"]["pixels"] + result["outside"]["pixels"] == 6 * 160 * (90 - EGO_ROWS)


class Riding(Own):
    """A grid of Gaussians that fills the leading car's box and moves with it, as the car's own part if `knows`."""

    def __init__(self, known: DriveTruth, knows: bool, beside: float = 0.0):
        axes = [np.linspace(-0.5, 0.5, n) * share for n, share in ((5, 0.95), (4, 0.95), (4, 0.95))]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        frames = [frame for frame, _ in front_frames(known)]
        boxes = [leading_box(known, frame) for frame in frames]
        super().__init__(purple(grid * boxes[0].size + [0.0, beside, 0.0]), boxes[0].track_id if knows else "another")
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
    for (frame, _), (image, inside, outside) in zip(front_frames(known), hulls(known), strict=True):
        view = view_of(known.recording.record, known.recording.scene.frames.index(frame), CPU)
        metrics.add(metrics.measure(rendered(model, view), image, {"box": inside, "outside": outside}))
    return metrics.summary()


@pytest.mark.parametrize("knows", [False, True])
def test_removing_a_car_equals_a_model_without_it(known, removal_of_grey, knows):
    """The figures equal those of a model without the car, and improve, for removal by box and by part."""
    model = flat_model(parts=[Riding(known, knows)])
    removed, never = removal_metrics(model, known, "CAM_FRONT", MARGIN, None, CPU), removal_of_grey
    for region in ("box", "outside"):
        assert removed[region]["psnr"] == pytest.approx(never[region]["psnr"], abs=1e-6)
        assert removed[region]["ssim"] == pytest.approx(never[region]["ssim"], abs=1e-6)
    assert unremoved(model, known)["box"]["psnr"] < removed["box"]["psnr"] - 3.0


@pytest.mark.parametrize("knows", [False, True])
def test_the_removal_baseline_uses_the_same_pixels_of_the_unedited_model(known, knows):
    model = flat_model(parts=[Riding(known, knows)])
    removed = removal_metrics(model, known, "CAM_FRONT", MARGIN, None, CPU)
    before, by_hand = removed["not_removed"], unremoved(model, known)
    assert before.keys() == {"box", "outside"}
    for region in ("box", "outside"):
        assert before[region]["pixels"] == removed[region]["pixels"]
        assert before[region]["psnr"] == pytest.approx(by_hand[region]["psnr"], abs=0.02)
        assert before[region]["ssim"] == pytest.approx(by_hand[region]["ssim"], abs=1e-3)
    assert before["box"]["psnr"] < removed["box"]["psnr"] - 3.0


def inputs_of(known: DriveTruth, truth: Path | None) -> EvaluationInputs:
    return EvaluationInputs(EMPTY_CHECKPOINT, {}, known.recording, EMPTY_MASKS, lpips_record=None, truth=truth)


def job_of(camera: str, synthetic: bool = True) -> EvaluateJob:
    return EvaluateJob(
        eval_camera=camera, cameras=("CAM_FRONT", "CAM_BACK"), sweeps=False, holdout=HOLDOUT, lpips=False, lidar=LIDAR,
        removal=RemovalSettings(margin=MARGIN) if synthetic else None,
    )  # fmt: skip


def test_a_recorded_drive_is_not_compared_with_ground_truth(known):
    """Its job has no removal, and a truth.json beside its tables is ignored."""
    job = job_of("CAM_FRONT", synthetic=False)
    assert truth_metrics(flat_model(), inputs_of(known, known.path), job, None, CPU) == {}


def test_a_street_without_a_leading_car_has_lateral_views_and_no_removal(known):
    views = tuple(view for view in known.truth.views if view.without is None)
    alone = dataclasses.replace(known, truth=dataclasses.replace(known.truth, views=views, leading=None))
    assert removal_metrics(flat_model(), alone, "CAM_FRONT", MARGIN, None, CPU) is None
    assert lateral_metrics(flat_model(), alone, "CAM_FRONT", None, CPU)["2.0"]["all"]["pixels"] == 6 * 90 * 160


def good(known: DriveTruth) -> dict[str, Any]:
    return json.loads(known.path.read_text())


def damaged(content: dict[str, Any], how: str) -> str:
    """truth.json, spoilt."""
    view = content["views"][0]

    def first_view(**changes: Any) -> str:
        return json.dumps({**content, "views": [{**view, **changes}]})

    spoilt = {
        "empty": "",
        "truncated": json.dumps(content)[:-40],
        "a list": "[]",
        "a word": '"truth"',
        "null": "null",
        "of another schema": json.dumps({**content, "schema": 1}),
        "without schema": json.dumps({k: v for k, v in content.items() if k != "schema"}),
        "without views": json.dumps({k: v for k, v in content.items() if k != "views"}),
        "with a foreign field": json.dumps({**content, "colour": "red"}),
        "without frames": first_view(frames=None),
        "with frames by name": first_view(frames={"0": view["frames"][0]}),
        "with a short frame": first_view(frames=[{"token": "a"}]),
        "with a foreign field of a view": first_view(colour="red"),
    }
    return spoilt[how]


@pytest.mark.parametrize(
    "how",
    [
        "empty", "truncated", "a list", "a word", "null", "of another schema", "without schema", "without views",
        "with a foreign field", "without frames", "with frames by name", "with a short frame",
        "with a foreign field of a view",
    ],
)  # fmt: skip
def test_an_invalid_truth_file_is_refused_naming_file_and_rule(known, tmp_path, how):
    path = tmp_path / "truth.json"
    path.write_text(damaged(good(known), how))
    with pytest.raises(ResultError) as refusal:
        read_truth(path)
    assert str(path) in str(refusal.value) and "demo_world" in str(refusal.value)


def test_a_missing_truth_is_refused_naming_file_and_rule(tmp_path):
    with pytest.raises(ResultError, match=r"nowhere/truth\.json.*demo_world"):
        read_truth(tmp_path / "nowhere" / "truth.json")


def with_image(known: DriveTruth, name: str) -> DriveTruth:
    """The truth with another image in every frame."""
    views = [
        dataclasses.replace(view, frames=tuple(dataclasses.replace(frame, image=name) for frame in view.frames))
        for view in known.truth.views
    ]
    return with_views(known, *views)


def test_a_missing_ground_truth_image_is_named_with_its_rule(known):
    assert truth_image(known.path, lateral_frames(known, 2.0)[0][1].image).is_file()
    with pytest.raises(ResultError, match=r"lateral/9999\.png.*demo_world"):
        lateral_metrics(flat_model(), with_image(known, "lateral/9999.png"), "CAM_FRONT", None, CPU)


def test_figures_are_bit_identical_for_any_number_of_threads(known):
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 3):
            torch.set_num_threads(threads)
            assert measuring_threads() == threads
            model = flat_model(parts=[Riding(known, True)])
            lateral = lateral_metrics(model, known, "CAM_FRONT", None, CPU)
            found.append((lateral, removal_metrics(model, known, "CAM_FRONT", MARGIN, None, CPU)))
    finally:
        torch.set_num_threads(before)
    assert found[0] == found[1] and all(figures is not None for figures in found[0])
