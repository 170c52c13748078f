"""What a job is about, and the config that applies to it."""

from dataclasses import dataclass

from drivesplat.settings.config import Config
from drivesplat.settings.dataset import DatasetSettings
from drivesplat.settings.tracks import Tracks


@dataclass(frozen=True)
class JobScope:
    """The dataset, scene, method and film (trajectory or edit; of a folder of a drive or of scans with its kind,
    'edits/…') of a job, empty where it has none, and the config that applies to it. `scene` is also empty for stages
    that are not in OF_ONE_SCENE."""

    config: Config
    dataset_name: str
    scene: str
    method: str
    film: str

    @property
    def dataset(self) -> DatasetSettings:
        return self.config.datasets[self.dataset_name]

    @property
    def tracks(self) -> Tracks:
        """The tracks that the method trains with; the annotated ones without a method."""
        return self.config.all_methods[self.method].tracks if self.method else "annotated"
