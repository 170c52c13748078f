"""Evaluation data: the recorded images, labels and splits with which renderings of a model are compared."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drivesplat.io.storage import Provenance
from drivesplat.scene.images import read_image
from drivesplat.scene.masks import read_labels, read_masks_record
from drivesplat.scene.regions import LABELS, label_image
from drivesplat.scene.scene import Frame, Scene, read_scene
from drivesplat.scene.training_record import TrainingRecord, read_training_record


@dataclass(frozen=True)
class EvaluationData:
    """A `scene`, its training `record`, whose images are the scene's frames in the same order, and the folder of the
    stage `masks`; without it the labels are computed from the scene's boxes."""

    scene: Scene
    record: TrainingRecord
    masks: Path | None = None

    def frame(self, index: int) -> Frame:
        return self.scene.frames[index]

    def size(self, index: int) -> tuple[int, int]:
        """Width and height in pixels at which an image is trained and measured."""
        return self.record.image_size(index)

    def image(self, index: int) -> np.ndarray:
        """A recorded image (h, w, 3) in [0, 1]."""
        return read_image(self.frame(index).image_path, self.size(index)) / 255.0

    def labels(self, index: int) -> np.ndarray:
        """The label image (h, w) of an image."""
        frame, size = self.frame(index), self.size(index)
        if self.masks is None:
            return label_image(self.scene, frame, size)
        return read_labels(self.masks, frame.camera, frame.timestamp, size)

    def ego_mask(self, index: int) -> np.ndarray:
        """The pixels (h, w) bool of an image that show the body of the ego vehicle."""
        return self.labels(index) == LABELS["own_car"]

    def split(self, index: int) -> str | None:
        """The split of an image: 'train', a held-out group or 'excluded'."""
        return next((name for name, images in self.record.splits.items() if index in images), None)


def read_evaluation_data(
    scene: str | Path, parser: str | Path, masks: str | Path
) -> tuple[EvaluationData, list[Provenance]]:
    """Reads scene.json, parser.npz and masks.json; returns the drive and the provenances of these files."""
    drive = EvaluationData(read_scene(scene), read_training_record(parser), Path(masks).parent)
    record = read_masks_record(drive.masks)
    return drive, [drive.scene.provenance, drive.record.provenance, record.provenance]
