"""The stage `train`: from a training record to checkpoint.npz and train.json."""

import dataclasses
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from drivesplat.errors import TrainingError
from drivesplat.io.prefetch import prefetch
from drivesplat.io.storage import Provenance, canonical_json, read_record, sha256_text, write_json
from drivesplat.kernels import triton_support
from drivesplat.kernels.road_distance import Road
from drivesplat.lidar.depth_record import PixelDepths, read_lidar_depth
from drivesplat.machine.device import choose_device, explain_out_of_memory, flush_denormals
from drivesplat.model.build import ModelInit, build_model, gaussian_cap
from drivesplat.model.checkpoint import TrainedCheckpoint, write_checkpoint, write_training_record
from drivesplat.model.road import RoadPart
from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.images import below_horizon
from drivesplat.scene.masks import NO_MASKS, read_classes, read_labels, read_masks_record, read_sky_mask
from drivesplat.scene.regions import LABELS, region_mask
from drivesplat.scene.scan_record import RecordedScan, read_scans
from drivesplat.scene.splits import HELD_OUT_GROUPS
from drivesplat.scene.training_record import TrainingRecord, read_training_record
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.train import TrainJob, TrainSettings
from drivesplat.training import resume_state
from drivesplat.training.augmentation import choose_mirrored, dropout_share
from drivesplat.training.exposure_init import gains_over_time, initial_gains
from drivesplat.training.loop import TrainingFolders, TrainingSummary, train
from drivesplat.training.previous_block import PreviousBlock, read_previous, start_from
from drivesplat.training.probes import MAX_OF_GROUP, NO_PROBES, CurveImage, Probes, evenly_spaced
from drivesplat.training.road import road_of
from drivesplat.training.road_seed import in_layer_of, road_seed
from drivesplat.training.scans import TrainingScan, initial_lidar_logits, load_scans, with_scan_points
from drivesplat.training.unseen import fill_unseen
from drivesplat.training.views import Supervision, TrainingView, load_views
from drivesplat.trajectories.actor_record import ActorRecord, read_actors


@dataclass(frozen=True)
class TrainingInputs:
    """The inputs of a training: the training record, the folder of masks (None: there are no images), the records of
    actors and of LiDAR depth (empty where the method does not use them), the number of semantic `classes` in the user's
    maps (0: none), the cameras that see the ego vehicle, `sky_known` (False where no sky was found, so that sky masks
    say nothing), the LiDAR scans of the training split (empty where the method does not render LiDAR), and the
    `previous` block of a long drive, from which the training starts (None: from seed points)."""

    record: TrainingRecord
    masks: Path | None
    actors: list[ActorRecord]
    lidar_depth: list[PixelDepths]
    classes: int = 0
    cameras_with_ego: frozenset[str] = frozenset()
    sky_known: bool = True
    scans: list[RecordedScan] = dataclasses.field(default_factory=list)
    previous: PreviousBlock | None = None

    def supervision(self, job: TrainJob) -> Supervision:
        """The supervision of the training images that `job` uses."""
        images = self.record.train_images
        sky_wanted = self.sky_known and (job.sky != "none" or job.train.sky_bce_weight)
        not_sky_wanted = self.masks is not None and not self.sky_known and job.train.horizon_weight
        moving_wanted = self.actors and (job.train.dynamic_weight or job.sky == "cubemap")
        return Supervision(
            sky=_of_each(images, lambda i: read_sky_mask(*self._image(i))) if sky_wanted else {},
            moving=_of_each(images, self._moving) if moving_wanted else {},
            lidar={i: self.lidar_depth[i] for i in images} if self.lidar_depth else {},
            classes=_of_each(images, lambda i: read_classes(*self._image(i))) if self.semantic_classes(job) else {},
            ego_mask=_of_each(self.with_ego(images), self.ego_mask),
            not_sky=_of_each(images, self._below_horizon) if not_sky_wanted else {},
        )

    def with_ego(self, images: Sequence[int]) -> list[int]:
        """The images whose camera sees the ego vehicle."""
        return [i for i in images if self.record.camera_name(i) in self.cameras_with_ego]

    def ego_mask(self, index: int) -> np.ndarray:
        """The mask (h, w) of the ego vehicle in an image."""
        return read_labels(*self._image(index)) == LABELS["own_car"]

    def semantic_classes(self, job: TrainJob) -> int:
        """The number of semantic classes that `job` learns."""
        return self.classes if job.train.semantic_weight else 0

    def exposed(self, job: TrainJob) -> tuple[str, ...]:
        """The cameras whose exposure `job` compares with the reference camera: all others with training images."""
        if job.reference_camera is None:
            return ()
        seen = self.record.train_cameras
        return tuple(sorted(seen - {job.reference_camera}))

    def regions(self, index: int) -> dict[str, np.ndarray]:
        """The masks (h, w) of the static and of the moving pixels of an image, as the measuring protocol has them."""
        return {"static": region_mask(read_labels(*self._image(index)), "static"), "moving": self._moving(index)}

    def _moving(self, index: int) -> np.ndarray:
        labels = read_labels(*self._image(index))
        return region_mask(labels, "moving_vehicle") | region_mask(labels, "moving_human")

    def _below_horizon(self, index: int) -> np.ndarray:
        return below_horizon(self.record.Ks[index], self.record.camtoworlds[index], self.record.image_size(index))

    def _image(self, index: int) -> tuple[Path, str, int, tuple[int, int]]:
        """What the masks of an image are read by."""
        assert self.masks is not None
        at = int(self.record.timestamps[index])
        return self.masks, self.record.camera_name(index), at, self.record.image_size(index)


def read_inputs(
    parser: str,
    masks: Sequence[str],
    actors: Sequence[str],
    lidar_depth: Sequence[str],
    scans: Sequence[str] = (),
    previous_parser: Sequence[str] = (),
    previous: Sequence[str] = (),
) -> tuple[TrainingInputs, list[Provenance]]:
    """Reads the inputs of a training from the files of the parser and, where given, of masks, actors, LiDAR depth,
    scans, and the parser and the training of the block before; returns them with the provenances of these files."""
    record, folder = read_training_record(parser), next((Path(path).parent for path in masks), None)
    made = NO_MASKS if folder is None else read_masks_record(folder)
    moving = [read_actors(path) for path in actors]
    depths = [read_lidar_depth(path) for path in lidar_depth]
    revolutions = [read_scans(path) for path in scans]
    before = read_previous(previous_parser, previous)
    inputs = TrainingInputs(
        record,
        folder,
        [actor for it in moving for actor in it.actors],
        [image for it in depths for image in it.images],
        made.semantic_classes,
        frozenset(made.own_car),
        made.sky_known,
        [scan for it in revolutions for scan in it.of_group("train")],
        before,
    )
    others = (*moving, *depths, *revolutions, *([] if before is None else [before.checkpoint]))
    upstream = [record.provenance, *([] if folder is None else [made.provenance]), *(it.provenance for it in others)]
    return inputs, upstream


@dataclass(frozen=True)
class TrainingFiles:
    """The files that a training writes."""

    checkpoint: Path
    summary: Path

    @property
    def resume(self) -> Path:
        """The folder from which a killed training resumes; no rule declares it, so Snakemake keeps it."""
        return self.checkpoint.parent / "resume"


@dataclass(frozen=True)
class Prepared:
    """What the first iteration of a training needs, the images of its PSNR curves, and its LiDAR scans. The `road` is
    on the CPU, None where it is unknown or not wanted."""

    model: SplatModel
    views: list[TrainingView]
    settings: TrainSettings
    road: Road | None
    curves: list[CurveImage]
    scans: list[TrainingScan]


def prepare(inputs: TrainingInputs, job: TrainJob, device: torch.device) -> Prepared:
    """Loads the training images onto the device, builds an untrained model, and resolves in the settings what
    depends on the scene."""
    with explain_out_of_memory(lambda: 0):
        views = load_views(inputs.record, inputs.supervision(job), device)
    rays = sum(int(scan.measured.sum()) for scan in inputs.scans)
    record, cap = inputs.record, gaussian_cap(inputs.record, job.train, rays)
    if job.train.scans.per_image:
        record = with_scan_points(record, inputs.scans, job.train.scans, job.random_seed)
    more = len(record.points) - len(inputs.record.points)
    resolved = {"cap_max": cap + more, "dropout": dropout_share(record, job.train)}
    settings = job.train.model_copy(update=resolved)
    known = len(record.train_images) and (settings.road_weight or RoadPart.name in job.parts)
    road = road_of(inputs.record, settings.road) if known else None
    seed = None if road is None or RoadPart.name not in job.parts else road_seed(record, road, settings.cap_max)
    if seed is not None:
        kept = ~in_layer_of(seed.surface, record.points)
        record = dataclasses.replace(record, points=record.points[kept], points_rgb=record.points_rgb[kept])
        settings = settings.model_copy(update={"cap_max": settings.cap_max - len(seed.positions), "road_weight": 0.0})
    exposed = inputs.exposed(job)
    init = ModelInit(
        record,
        inputs.actors,
        mean_sky_color(views),
        inputs.semantic_classes(job),
        initial_gains(inputs.record, views, exposed, job.reference_camera) if exposed else {},
        job.reference_camera,
        initial_lidar_logits(inputs.scans) if job.train.scans.per_image else None,
        len(inputs.scans),
        seed,
        gains_over_time(inputs.record, views) if job.reference_camera and job.train.exposure.interval else {},
    )
    if job.sky != "mask" and not job.train.sky_bce_weight:  # no loss uses the masks, a byte per pixel on the device
        views = [dataclasses.replace(view, sky=None) for view in views]
    with explain_out_of_memory(lambda: 0):
        curves = curve_images(inputs, views, job, device)
        scans = load_scans(inputs.scans, job.train.scans, device) if job.train.scans.per_image else []
    if job.train.scans.per_image and not scans:
        raise TrainingError("no LiDAR scan is there to train with; set train.scans.per_image to 0")
    model = build_model(init, job.parts, job.sky, settings)
    if inputs.previous is not None:
        start_from(model, inputs.record, inputs.previous, settings.cap_max)
    choose_mirrored(model, record, settings)
    return Prepared(model, views, settings, road, curves, scans)


def curve_images(
    inputs: TrainingInputs, views: list[TrainingView], job: TrainJob, device: torch.device
) -> list[CurveImage]:
    """The images of PSNR curves: a few of the training's `views`, and a few of each held-out group, which nothing else
    in the training uses, with curves of their static and of their moving pixels."""
    if not job.train.psnr_every:
        return []
    record = inputs.record
    groups = {group: [int(i) for i in record.splits.get(group, ())] for group in HELD_OUT_GROUPS}
    held_out = {i: group for group, images in groups.items() for i in evenly_spaced(images, MAX_OF_GROUP)}
    masks = Supervision(sky={}, moving={}, lidar={}, ego_mask=_of_each(inputs.with_ego([*held_out]), inputs.ego_mask))
    images = [CurveImage(views[i], {"psnr/train": None}) for i in evenly_spaced(range(len(views)))]
    for index, view in zip(held_out, load_views(record, masks, device, [*held_out]), strict=True):
        curve = f"psnr/{held_out[index]}"
        regions = {f"{curve}/{name}": torch.from_numpy(mask).to(device) for name, mask in inputs.regions(index).items()}
        images.append(CurveImage(view, {"psnr/held_out": None, curve: None, **regions}))
    return images


def run_training(
    inputs: TrainingInputs,
    job: TrainJob,
    device_settings: DeviceSettings,
    files: TrainingFiles,
    provenance: Provenance,
    label: str,
    probes: Probes = NO_PROBES,
) -> None:
    """Trains and writes both files, or raises and writes neither. The resume state is kept after a failure, and where
    the parent process was killed meanwhile: Snakemake did not see this training end and will run it again."""
    started_by = os.getppid()
    with resume_state.training_lock(files.resume):
        device = choose_device(device_settings)
        triton_support.start_check(device)
        if job.train.scans.per_image:  # images never show some of the Gaussians that scans do
            flush_denormals()
        begun = prepare(inputs, job, device)
        fingerprint = sha256_text(
            canonical_json([provenance[k] for k in ("settings_sha256", "code_sha256", "inputs_sha256")])
        )
        model, seed = begun.model, job.random_seed
        folders = TrainingFolders(
            files.resume, files.checkpoint.parent / "tensorboard", fingerprint, label,
            lambda resume: write_training_record(resume, model, job, provenance),
        )  # fmt: skip
        summary = train(
            model, begun.views, begun.settings, seed, device, folders, begun.road,
            curves=begun.curves, scans=begun.scans, probes=probes,
        )  # fmt: skip
        with explain_out_of_memory(lambda: len(model)):
            fill_unseen(model, begun.views)
        write_checkpoint(files.checkpoint, TrainedCheckpoint.of(model, job, provenance))
        write_json(files.summary, {**dataclasses.asdict(summary), "provenance": provenance})
    if os.getppid() == started_by:
        shutil.rmtree(files.resume)


def read_summary(path: str | Path) -> dict[str, Any]:
    """Reads `train.json`. Raises ResultError for any other file."""
    return read_record(path, "train", *(field.name for field in dataclasses.fields(TrainingSummary)), "provenance")


def _of_each(images: Sequence[int], read: Callable[[int], np.ndarray]) -> dict[int, np.ndarray]:
    """Reads a value for each image, by its number."""
    return dict(zip(images, prefetch(read, images), strict=True))


def mean_sky_color(views: list[TrainingView]) -> np.ndarray:
    """The mean colour (3,) in [0, 1] of the sky pixels of the training images, of all pixels where there are none; grey
    without images."""
    sums, count = np.zeros(3), 0
    for view in views:
        if view.sky is not None:
            sums += (view.target() * view.sky[..., None]).sum(dim=(0, 1)).cpu().numpy()
            count += int(view.sky.sum())
    if count:
        return sums / count
    means = [view.target().mean(dim=(0, 1)).double().cpu().numpy() for view in views]
    return np.mean(means, axis=0) if means else np.full(3, 0.5)
