"""The metrics of the images of a recording that a model was not trained on, by group and region."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
import torch

from drivesplat.errors import DatasetError
from drivesplat.evaluation.metrics import (
    FrameErrors,
    LpipsMap,
    RegionMetrics,
    depth_summary,
    measuring_threads,
    relative_depth_errors,
    with_gap,
)  # fmt: skip
from drivesplat.evaluation.object_metrics import ObjectErrors, by_object, object_errors
from drivesplat.evaluation.synthetic import SURFACES, DriveTruth, rendered, rendered_with_depth
from drivesplat.io.prefetch import prefetch
from drivesplat.lidar.depth import depths_in, split_sweeps
from drivesplat.lidar.depth_record import PixelDepths
from drivesplat.model.splat_model import SplatModel
from drivesplat.model.view import view_of
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.regions import REGIONS, region_masks
from drivesplat.scene.splits import HELD_OUT_GROUPS, SIDE_CAMERA
from drivesplat.scene.training_record import TrainingRecord
from drivesplat.settings.lidar_depth import LidarDepthJob

OVERLAP_REGIONS = ("overlap", "no_overlap")


def evaluate_groups(
    model: SplatModel,
    recording: EvaluationData,
    camera: str,
    lpips_map: LpipsMap | None,
    device: torch.device,
    depths: Mapping[int, PixelDepths] = MappingProxyType({}),
) -> dict[str, dict[str, Any]]:
    """The metrics of every held-out group by region. With LiDAR `depths` of images, by index, also `depth`; with
    several cameras also `overlap` and `no_overlap`, the static pixels that other cameras see as well, and the rest."""
    measured = measure_groups(model, recording, camera, lpips_map, device, depths)
    return {group: own.metrics for group, own in measured.items()}


class GroupMeasurement(NamedTuple):
    """The record of a group of images, the records of its objects (`by_object`), and the errors of every image by
    region."""

    metrics: dict[str, Any]
    objects: list[dict[str, Any]]
    frames: dict[str, list[FrameErrors]]


def measure_groups(
    model: SplatModel,
    recording: EvaluationData,
    camera: str,
    lpips_map: LpipsMap | None,
    device: torch.device,
    depths: Mapping[int, PixelDepths],
    truth: DriveTruth | None = None,
) -> dict[str, GroupMeasurement]:
    """What `evaluate_groups` gives, with objects and single images. With the `truth` of a synthetic world that has
    class images of this camera also its SURFACES."""
    classes = truth.class_images(camera) if truth else {}
    of_group = partial(_group_metrics, model, recording, lpips_map, device, depths)
    surfaces = (lambda index, static: truth.surfaces(classes[index], static)) if truth and classes else None
    return {group: of_group(images, surfaces) for group, images in measured_images(recording.record, camera).items()}


def side_camera_metrics(
    model: SplatModel, recording: EvaluationData, lpips_map: LpipsMap | None, device: torch.device
) -> dict[str, dict[str, Any]]:
    """The metrics by region of each camera of `holdout.cameras`, over its key frames at which other cameras were
    trained on. LiDAR depth of these was trained on, too, and is not measured."""
    record = recording.record
    left_out = [int(i) for i in record.splits[SIDE_CAMERA] if record.is_key_frame[i]]
    cameras = sorted({record.camera_name(index) for index in left_out})
    images = {camera: [i for i in left_out if record.camera_name(i) == camera] for camera in cameras}
    return {name: _group_metrics(model, recording, lpips_map, device, {}, own).metrics for name, own in images.items()}


def _group_metrics(
    model: SplatModel,
    recording: EvaluationData,
    lpips_map: LpipsMap | None,
    device: torch.device,
    depths: Mapping[int, PixelDepths],
    images: list[int],
    surfaces: Callable[[int, np.ndarray], dict[str, np.ndarray]] | None = None,
) -> GroupMeasurement:
    """The metrics of a held-out group of `images`. `surfaces` gives the masks of SURFACES of an
    image, by its index and its static pixels."""
    record = recording.record
    several_cameras = len(record.camera_names) > 1
    more = (*(OVERLAP_REGIONS if several_cameras else ()), *(SURFACES if surfaces else ()))
    metrics = RegionMetrics(lpips_map, (*REGIONS, *more), device)
    depth_errors: list[np.ndarray] = []

    def renderings() -> Iterator[tuple[int, np.ndarray]]:
        for index in images:
            view = view_of(record, index, device)
            if index not in depths:
                yield index, rendered(model, view)
                continue
            image, metres = rendered_with_depth(model, view)
            depth_errors.append(relative_depth_errors(metres, depths[index]))
            yield index, image

    def measure(one: tuple[int, np.ndarray]) -> tuple[dict[str, FrameErrors], list[ObjectErrors]]:
        (index, image), labels = one, recording.labels(one[0])
        masks, truth = region_masks(labels), recording.image(index)
        if surfaces:
            masks |= surfaces(index, masks["static"])
        if several_cameras:
            masks |= overlap_masks(record, index, masks["static"])
        return metrics.measure(image, truth, masks), object_errors(recording, index, image, truth, labels)

    objects: list[ObjectErrors] = []
    for frame, of_objects in prefetch(measure, renderings(), measuring_threads()):
        metrics.add(frame)
        objects += of_objects
    whole = {**with_gap(metrics.summary()), **depth_summary(depth_errors)}
    return GroupMeasurement(whole, by_object(objects), metrics.frames)


def held_out_depths(recording: EvaluationData, camera: str, job: LidarDepthJob) -> dict[int, PixelDepths]:
    """LiDAR depth of the measured images by index, from the sweep of their own key frame; without images whose sweep is
    missing."""
    scene = recording.scene
    clouds = {cloud.sample_index: cloud for cloud in split_sweeps(scene, job, HELD_OUT_GROUPS)}
    images = [i for group in HELD_OUT_GROUPS for i in held_out_images(recording.record, group, camera)]
    owned = {i: clouds[scene.frames[i].sample_index] for i in images if scene.frames[i].sample_index in clouds}
    return {i: depths_in(scene, scene.frames[i], cloud, job, recording.ego_mask(i)) for i, cloud in owned.items()}


def held_out_images(record: TrainingRecord, group: str, camera: str) -> list[int]:
    """The indices of the images of `group` (or 'train') that are measured: key frames of the evaluated camera.

    Raises DatasetError if the scene lacks that camera.
    """
    if camera not in record.camera_names:
        raise DatasetError(
            f"eval_camera {camera} is not among the cameras of this run ({', '.join(record.camera_names)})"
        )
    wanted = record.camera_names.index(camera)
    return [int(i) for i in record.splits[group] if record.camera_indices[i] == wanted and record.is_key_frame[i]]


def measured_images(record: TrainingRecord, camera: str) -> dict[str, list[int]]:
    """The indices of the measured images by held-out group. Raises DatasetError as `held_out_images` does."""
    return {group: held_out_images(record, group, camera) for group in HELD_OUT_GROUPS}


def seen_by_others(record: TrainingRecord, index: int) -> np.ndarray:
    """The pixels (h, w) bool of image `index` whose viewing direction lies in another camera's image of that key frame.

    Only directions count, as for distant points: cameras are about a metre apart, and no reconstructed depth is needed.
    """
    width, height = record.image_size(index)
    columns, rows = np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5
    to_world = record.camtoworlds[index][:3, :3] @ np.linalg.inv(record.Ks[index])
    seen = np.zeros((height, width), dtype=bool)
    simultaneous = record.is_key_frame & (record.sample_indices == record.sample_indices[index])
    for other in np.flatnonzero(simultaneous & (record.camera_indices != record.camera_indices[index])).tolist():
        homography = record.Ks[other] @ record.camtoworlds[other][:3, :3].T @ to_world
        x, y, depth = (of_column * columns + (of_row * rows + constant) for of_column, of_row, constant in homography)
        other_width, other_height = record.image_size(other)
        inside = (x >= 0) & (x < other_width * depth) & (y >= 0) & (y < other_height * depth)
        seen |= inside & (depth > 0)
    return seen


def overlap_masks(record: TrainingRecord, index: int, static: np.ndarray) -> dict[str, np.ndarray]:
    """The `static` pixels (h, w) bool of an image, split into those that other cameras see as well and the others."""
    seen = seen_by_others(record, index)
    return {"overlap": static & seen, "no_overlap": static & ~seen}
