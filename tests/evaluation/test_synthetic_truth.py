"""Renderings against synthetic ground truth: the figures of simple models can be computed from the PNGs."""

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from helpers.hand_made import Own, recording_of, round_gaussians, write_labels
from helpers.records import EMPTY_CHECKPOINT, EMPTY_MASKS
from PIL import Image
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity

from drivesplat.errors import DatasetError, ResultError
from drivesplat.evaluation.evaluate import EvaluationInputs, truth_metrics
from drivesplat.evaluation.metrics import RegionMetrics, measuring_threads
from drivesplat.evaluation.synthetic import DriveTruth, lateral_metrics, removal_metrics, rendered
from drivesplat.model.background import Background
from drivesplat.model.gaussians import Gaussians
from drivesplat.model.sky import ConstantSky
from drivesplat.model.splat_model import Picture, SplatModel
from drivesplat.model.view import View, view_of
from drivesplat.preprocess.extract import extract_scene
from drivesplat.readers.truth import Truth, TruthFrame, read_truth, truth_image
from drivesplat.scene.regions import LABELS
from drivesplat.scene.rigid import rigid
from drivesplat.scene.scene import Frame
from drivesplat.scene.tracks import Box, box_at, boxes_at
from drivesplat.settings.evaluate import EvaluateJob
from drivesplat.settings.extract import SceneSource
from drivesplat.settings.images import HoldoutSettings, ImageSettings
from drivesplat.settings.inspection import RemovalSettings
from drivesplat.settings.lidar_depth import LidarDepthJob

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


@pytest.fixture(scope="module")
def known(demo_root, tmp_path_factory) -> DriveTruth:
    source = SceneSource(
        dataset="demo", reader="nuscenes", version="v1.0-mini", scene="demo", frames=None,
        cameras=("CAM_FRONT", "CAM_BACK"), sweeps=False, on_missing="stop",
    )  # fmt: skip
    scene = extract_scene(source, demo_root)
    labels = np.full((90, 160), LABELS["static"], dtype=np.uint8)
    labels[90 - EGO_ROWS :] = LABELS["own_car"]
    masks = write_labels(tmp_path_factory.mktemp("masks"), scene, labels)
    path = demo_root / "truth" / "truth.json"
    return DriveTruth(read_truth(path), path, recording_of(scene, masks, **HOLDOUT.model_dump()))


def flat_model(color=GREY, parts=()) -> SplatModel:
    """No Gaussians but those of `parts`; a sky of one colour."""
    return SplatModel([*parts, round_gaussians([])], ConstantSky(torch.tensor(color), 1e-2)).requires_grad_(False)


def purple(places) -> Background:
    return round_gaussians(places, 0.3, 0.98, (0.9, 0.1, 0.9))


def front_frames(known: DriveTruth) -> list[tuple[Frame, TruthFrame]]:
    frames = [frame for frame in known.recording.scene.frames if frame.camera == "CAM_FRONT"]
    return list(zip(frames, known.truth.frames, strict=True))


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


def lateral_pose(known: DriveTruth, truth: TruthFrame) -> np.ndarray:
    pose = np.array(truth.lateral_camera_to_global)
    pose[:3, 3] -= known.recording.scene.origin
    return pose


def leading_box(known: DriveTruth, frame: Frame) -> Box:
    track = next(track for track in known.recording.scene.tracks if track.id == known.truth.leading)
    return box_at(track, frame.timestamp, known.recording.scene.key_frame_interval)


def by_hand(color, images: list[np.ndarray], masks: list[np.ndarray]) -> float:
    """The PSNR of a constant colour over the pixels of all frames."""
    errors = np.concatenate([((image - np.array(color)) ** 2)[mask] for image, mask in zip(images, masks, strict=True)])
    return -10.0 * np.log10(errors.mean())


def test_a_constant_colours_lateral_psnr_follows_from_the_pngs(known):
    result = lateral_metrics(flat_model(), known, "CAM_FRONT", None, CPU)
    assert list(result) == ["2.0"] and result["2.0"].keys() == {"all", "static"}
    images = [pixels_of(known, truth.lateral) for _, truth in front_frames(known)]
    everywhere = [np.ones((90, 160), dtype=bool)] * 6
    assert result["2.0"]["all"]["psnr"] == pytest.approx(by_hand(GREY, images, everywhere), abs=1e-4)
    assert result["2.0"]["all"]["pixels"] == 6 * 90 * 160
    similarity = [
        structural_similarity(
            np.broadcast_to(GREY, image.shape), image, data_range=1.0, channel_axis=2, gaussian_weights=True,
            sigma=1.5, use_sample_covariance=False, full=True,
        )[1].mean()
        for image in images
    ]  # fmt: skip
    assert result["2.0"]["all"]["ssim"] == pytest.approx(np.mean(similarity), abs=1e-5)
    assert result["2.0"]["all"]["lpips"] is None


def test_static_pixels_beside_the_path_are_those_of_the_view_from_there(known):
    """They are outside all boxes of movable objects, as seen by the lateral camera and not the recorded one."""
    images, static, recorded = [], [], []
    for frame, truth in front_frames(known):
        boxes = [box for box in boxes_at(known.recording.scene, frame.timestamp) if box.object_class.is_dynamic]
        images.append(pixels_of(known, truth.lateral))
        for masks, pose in ((static, lateral_pose(known, truth)), (recorded, frame.camera_to_world)):
            masks.append(~np.any([rays_meet(box, pose, frame) for box in boxes], axis=0))
    result = lateral_metrics(flat_model(), known, "CAM_FRONT", None, CPU)["2.0"]["static"]
    assert result["pixels"] == pytest.approx(sum(mask.sum() for mask in static), rel=1e-4)
    assert result["psnr"] == pytest.approx(by_hand(GREY, images, static), abs=0.005)
    assert sum((a != b).sum() for a, b in zip(static, recorded, strict=True)) > 300, "the two views must differ"


class Watched(SplatModel):
    """A flat model that records the requested views."""

    def __init__(self):
        super().__init__([round_gaussians([])], ConstantSky(torch.tensor(GREY), 1e-2))
        self.views: list[View] = []

    def render(self, view: View, *arguments: Any, **options: Any) -> Picture:
        self.views.append(view)
        return super().render(view, *arguments, **options)


def ego_to_global(tables, sample_data: str) -> np.ndarray:
    pose = tables.get("ego_pose", tables.get("sample_data", sample_data)["ego_pose_token"])
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_quat(np.roll(pose["rotation"], -1)).as_matrix()
    matrix[:3, 3] = pose["translation"]
    return matrix


def test_the_lateral_view_is_two_metres_to_the_left_of_the_ego_vehicle(known, demo_tables):
    model = Watched()
    lateral_metrics(model, known, "CAM_FRONT", None, CPU)
    assert len(model.views) == 6
    for view, (frame, truth) in zip(model.views, front_frames(known), strict=True):
        pose = view.camera_to_world.double().numpy()
        pose[:3, 3] += known.recording.scene.origin
        recorded = frame.camera_to_world.copy()
        recorded[:3, 3] += known.recording.scene.origin
        ego = ego_to_global(demo_tables, truth.sample_data)
        step = np.linalg.inv(ego) @ pose - np.linalg.inv(ego) @ recorded
        np.testing.assert_allclose(step[:3, 3], [0.0, 2.0, 0.0], atol=2e-5)
        np.testing.assert_allclose(pose[:3, :3], recorded[:3, :3], atol=1e-6)
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
def test_with_pose_errors_the_lateral_view_is_relative_to_the_recorded_pose(known, demo_tables, seed):
    """The camera moves along the ego vehicle's y axis and does not rotate."""
    model, off = Watched(), nudged(known, seed)
    lateral_metrics(model, off, "CAM_FRONT", None, CPU)
    assert len(model.views) == 6
    for view, (frame, truth) in zip(model.views, front_frames(off), strict=True):
        data = demo_tables.get("sample_data", truth.sample_data)
        w, x, y, z = demo_tables.get("calibrated_sensor", data["calibrated_sensor_token"])["rotation"]
        to_left = Rotation.from_quat([x, y, z, w]).inv().apply([0.0, 2.0, 0.0])
        step = np.linalg.inv(frame.camera_to_world) @ view.camera_to_world.double().numpy()
        np.testing.assert_allclose(step, rigid(np.eye(3), to_left), atol=2e-5)
        true_pose = lateral_pose(off, truth)
        assert np.abs(view.camera_to_world.numpy() - true_pose).max() > 0.05, "the true view is elsewhere"


def test_with_pose_errors_dynamic_boxes_are_masked_in_the_rendered_view(known):
    """Static pixels are those outside the boxes in the rendered view."""
    model, off = Watched(), nudged(known, 0)
    result = lateral_metrics(model, off, "CAM_FRONT", None, CPU)["2.0"]["static"]
    count = 0
    for view, (frame, _) in zip(model.views, front_frames(off), strict=True):
        boxes = [box for box in boxes_at(off.recording.scene, frame.timestamp) if box.object_class.is_dynamic]
        pose = view.camera_to_world.double().numpy()
        count += (~np.any([rays_meet(box, pose, frame) for box in boxes], axis=0)).sum()
    assert result["pixels"] == pytest.approx(count, rel=1e-4)


def hulls(known: DriveTruth) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Per key frame: the street without the leading car, and the pixels inside and outside its box (no ego vehicle)."""
    free = np.arange(90)[:, None] < 90 - EGO_ROWS
    for frame, truth in front_frames(known):
        inside = rays_meet(leading_box(known, frame), frame.camera_to_world, frame)
        yield pixels_of(known, truth.without_leading), inside & free, ~inside & free


def test_a_constant_colours_removal_psnr_follows_from_the_pngs(known):
    images, inside, outside = (list(items) for items in zip(*hulls(known), strict=True))
    result = removal_metrics(flat_model(), known, "CAM_FRONT", MARGIN, None, CPU)
    assert result.keys() == {"box", "outside", "not_removed"}
    for region, masks in (("box", inside), ("outside", outside)):
        assert result[region]["pixels"] == pytest.approx(sum(mask.sum() for mask in masks), abs=6)
        assert result[region]["psnr"] == pytest.approx(by_hand(GREY, images, masks), abs=0.02)
    assert result["box"]["pixels"] > 1000
    assert result["box"]["pixels"] + result["outside"]["pixels"] == 6 * 160 * (90 - EGO_ROWS)


def test_pixels_of_the_ego_vehicle_are_neither_inside_nor_outside_the_removed_box(known, tmp_path):
    """The ego vehicle hides everything below the middle of the leading car's box in the first key frame."""
    frame = front_frames(known)[0][0]
    rows = np.flatnonzero(rays_meet(leading_box(known, frame), frame.camera_to_world, frame).any(axis=1))
    free = np.arange(90)[:, None] < int(rows.mean())
    labels = np.where(free, LABELS["static"], LABELS["own_car"]).repeat(160, axis=1).astype(np.uint8)
    recording = dataclasses.replace(known.recording, masks=write_labels(tmp_path, known.recording.scene, labels))
    hidden = dataclasses.replace(known, recording=recording)
    result = removal_metrics(flat_model(), hidden, "CAM_FRONT", MARGIN, None, CPU)
    images, inside, outside = (list(items) for items in zip(*hulls(known), strict=True))
    assert sum((mask & ~free).sum() for mask in inside) > 0
    for region, masks in (("box", inside), ("outside", outside)):
        seen = [mask & free for mask in masks]
        assert result[region]["pixels"] == pytest.approx(sum(mask.sum() for mask in seen), abs=6)
        assert result[region]["psnr"] == pytest.approx(by_hand(GREY, images, seen), abs=0.02)


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

    def at(self, time: float) -> Gaussians:
        pose = self._poses[round(time, 3)]
        still = super().at(time)
        return dataclasses.replace(still, means=still.means @ pose[:3, :3].T + pose[:3, 3])


def unremoved(model: SplatModel, known: DriveTruth) -> dict[str, Any]:
    """The model with the car against the street without it."""
    metrics = RegionMetrics(None, ("box", "outside"))
    for (frame, _), (image, inside, outside) in zip(front_frames(known), hulls(known), strict=True):
        view = view_of(known.recording.record, known.recording.scene.frames.index(frame), CPU)
        metrics.add(metrics.measure(rendered(model, view), image, {"box": inside, "outside": outside}))
    return metrics.summary()


@pytest.mark.parametrize("knows", [False, True])
def test_removing_a_car_equals_a_model_without_it(known, knows):
    """The figures equal those of a model without the car, and improve, for removal by box and by part."""
    model = flat_model(parts=[Riding(known, knows)])
    removed = removal_metrics(model, known, "CAM_FRONT", MARGIN, None, CPU)
    never = removal_metrics(flat_model(), known, "CAM_FRONT", MARGIN, None, CPU)
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


def test_without_a_removal_there_is_no_baseline(known):
    result = removal_metrics(flat_model(), known, "CAM_FRONT", MARGIN, None, CPU)
    assert result.pop("not_removed") == result


def test_gaussians_outside_the_box_are_removed_only_by_their_part(known):
    """The same Gaussians three metres to the car's left."""
    by_box, by_actor = (
        removal_metrics(flat_model(parts=[Riding(known, knows, beside=3.0)]), known, "CAM_FRONT", MARGIN, None, CPU)
        for knows in (False, True)
    )
    never = removal_metrics(flat_model(), known, "CAM_FRONT", MARGIN, None, CPU)
    assert by_actor["outside"]["psnr"] == pytest.approx(never["outside"]["psnr"], abs=1e-6)
    assert by_box["outside"]["psnr"] != pytest.approx(never["outside"]["psnr"], abs=0.05)


def test_gaussians_near_the_box_are_removed_within_the_margin(known):
    """Gaussians 0.3 m above the roof are removed only with a margin of 0.5 m."""
    frame = front_frames(known)[0][0]
    box = leading_box(known, frame)
    over = box.object_to_world @ np.array([0.0, 0.0, box.size[2] / 2 + 0.3, 1.0])
    model = flat_model(parts=[purple(over[None, :3])])
    never = removal_metrics(flat_model(), known, "CAM_FRONT", 0.0, None, CPU)["outside"]["psnr"]
    psnrs = [removal_metrics(model, known, "CAM_FRONT", m, None, CPU)["outside"]["psnr"] for m in (0.1, 0.5)]
    assert abs(psnrs[0] - never) > abs(psnrs[1] - never)


@pytest.mark.parametrize("camera", ["CAM_BACK", "CAM_LEFT"])
def test_other_cameras_have_no_ground_truth(known, camera):
    assert lateral_metrics(flat_model(), known, camera, None, CPU) is None
    assert removal_metrics(flat_model(), known, camera, MARGIN, None, CPU) is None


def inputs_of(known: DriveTruth, truth: Path | None) -> EvaluationInputs:
    return EvaluationInputs(EMPTY_CHECKPOINT, {}, known.recording, EMPTY_MASKS, lpips_record=None, truth=truth)


def job_of(camera: str, synthetic: bool = True) -> EvaluateJob:
    return EvaluateJob(
        eval_camera=camera, cameras=("CAM_FRONT", "CAM_BACK"), sweeps=False, holdout=HOLDOUT, lpips=False, lidar=LIDAR,
        removal=RemovalSettings(margin=MARGIN) if synthetic else None,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("has_truth", "camera", "keys"),
    [(True, "CAM_FRONT", {"lateral", "removal"}), (True, "CAM_BACK", set()), (False, "CAM_FRONT", set())],
)
def test_ground_truth_figures_require_ground_truth(known, has_truth, camera, keys):
    found = truth_metrics(flat_model(), inputs_of(known, known.path if has_truth else None), job_of(camera), None, CPU)
    assert found.keys() == keys
    json.dumps(found, allow_nan=False)


def test_a_recorded_drive_is_not_compared_with_ground_truth(known):
    """Its job has no removal, and a truth.json beside its tables is ignored."""
    job = job_of("CAM_FRONT", synthetic=False)
    assert truth_metrics(flat_model(), inputs_of(known, known.path), job, None, CPU) == {}


def test_frames_with_ground_truth_are_those_of_its_camera(known):
    numbers = [index for index, _ in known.frames("CAM_FRONT")]
    frames = known.recording.scene.frames
    assert numbers == [index for index, frame in enumerate(frames) if frame.camera == "CAM_FRONT"] and len(numbers) == 6
    assert [truth.sample_data for _, truth in known.frames("CAM_FRONT")] == [frames[i].token for i in numbers]
    assert not list(known.frames("CAM_BACK"))


def changed(known: DriveTruth, leading: str | None = None, **changes: Any) -> DriveTruth:
    """The truth with every frame changed."""
    frames = tuple(dataclasses.replace(frame, **changes) for frame in known.truth.frames)
    return dataclasses.replace(known, truth=dataclasses.replace(known.truth, frames=frames, leading=leading))


def test_a_street_without_a_leading_car_has_a_lateral_view_and_no_removal(known):
    alone = changed(known, without_leading=None)
    assert removal_metrics(flat_model(), alone, "CAM_FRONT", MARGIN, None, CPU) is None
    assert lateral_metrics(flat_model(), alone, "CAM_FRONT", None, CPU)["2.0"]["all"]["pixels"] == 6 * 90 * 160


def test_frames_without_the_leading_car_are_not_measured(known):
    """Its track ends half an interval after key frame 1."""
    tracks = []
    for track in known.recording.scene.tracks:
        cut = track.id == known.truth.leading
        arrays = ("timestamps", "sample_indices", "object_to_world", "visibility")
        tracks.append(dataclasses.replace(track, **{a: getattr(track, a)[:2] for a in arrays}) if cut else track)
    scene = dataclasses.replace(known.recording.scene, tracks=tuple(tracks))
    short = dataclasses.replace(known, recording=dataclasses.replace(known.recording, scene=scene))
    result = removal_metrics(flat_model(), short, "CAM_FRONT", MARGIN, None, CPU)
    seen = list(hulls(known))[:2]
    assert result["outside"]["pixels"] == pytest.approx(sum(outside.sum() for _, _, outside in seen), abs=4)


def good(known: DriveTruth) -> dict[str, Any]:
    return json.loads(known.path.read_text())


def damaged(content: dict[str, Any], how: str) -> str:
    """truth.json, spoilt."""
    spoilt = {
        "empty": "",
        "truncated": json.dumps(content)[:-40],
        "a list": "[]",
        "a word": '"truth"',
        "null": "null",
        "of another schema": json.dumps({**content, "schema": 2}),
        "without schema": json.dumps({k: v for k, v in content.items() if k != "schema"}),
        "without camera": json.dumps({k: v for k, v in content.items() if k != "camera"}),
        "with a foreign field": json.dumps({**content, "colour": "red"}),
        "without frames": json.dumps({**content, "frames": None}),
        "with frames by name": json.dumps({**content, "frames": {"0": content["frames"][0]}}),
        "with a short frame": json.dumps({**content, "frames": [{"sample_data": "a"}]}),
    }
    return spoilt[how]


@pytest.mark.parametrize(
    "how",
    [
        "empty", "truncated", "a list", "a word", "null", "of another schema", "without schema", "without camera",
        "with a foreign field", "without frames", "with frames by name", "with a short frame",
    ],
)  # fmt: skip
def test_an_invalid_truth_file_is_refused_naming_file_and_rule(known, tmp_path, how):
    path = tmp_path / "truth.json"
    path.write_text(damaged(good(known), how))
    with pytest.raises(ResultError) as refusal:
        read_truth(path)
    assert str(path) in str(refusal.value) and "demo_world" in str(refusal.value)


def test_invalid_poses_in_a_truth_file_are_refused_naming_file_and_rule(known, tmp_path):
    content = good(known)
    content["frames"][0]["lateral_camera_to_global"] = [[1.0, 0.0]]
    path = tmp_path / "truth.json"
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError, match="demo_world"):
        read_truth(path)


def test_a_binary_truth_file_is_refused(tmp_path):
    path = tmp_path / "truth.json"
    path.write_bytes(b"\x89PNG\r\n\x1a\n\xff\xfe")
    with pytest.raises(ResultError, match="demo_world"):
        read_truth(path)


def test_a_missing_truth_is_refused_naming_file_and_rule(tmp_path):
    with pytest.raises(ResultError, match=r"nowhere/truth\.json.*demo_world"):
        read_truth(tmp_path / "nowhere" / "truth.json")


def test_truth_json_is_read_completely(known):
    content, truth = good(known), read_truth(known.path)
    assert content.pop("schema") == 1
    frames = content.pop("frames")
    assert [dataclasses.asdict(frame) for frame in truth.frames] == frames
    assert {key: getattr(truth, key) for key in content} == content
    assert isinstance(truth, Truth) and list(truth.by_image()) == [frame["sample_data"] for frame in frames]


def test_a_missing_ground_truth_image_is_named_with_its_rule(known):
    assert truth_image(known.path, known.truth.frames[0].lateral).is_file()
    with pytest.raises(ResultError, match=r"lateral/9999\.png.*demo_world"):
        lateral_metrics(flat_model(), changed(known, lateral="lateral/9999.png"), "CAM_FRONT", None, CPU)


def test_a_truncated_ground_truth_image_is_named(known, tmp_path):
    (tmp_path / "half.png").write_bytes((known.path.parent / known.truth.frames[0].lateral).read_bytes()[:400])
    moved = dataclasses.replace(changed(known, lateral="half.png"), path=tmp_path / "truth.json")
    with pytest.raises((ResultError, DatasetError), match=r"half\.png"):
        lateral_metrics(flat_model(), moved, "CAM_FRONT", None, CPU)


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
