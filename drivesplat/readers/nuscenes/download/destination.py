"""The destination of the download of nuScenes mini, and the checks before it: accepted terms and an empty folder.

Cheap to import: the Snakefile runs the checks before any job.
"""

from pathlib import Path

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.readers.nuscenes import layout
from drivesplat.settings.config import Config
from drivesplat.settings.download import DownloadJob

RULE = "download_nuscenes_mini"
"""The rule that downloads it."""
VERSION = "v1.0-mini"
TERMS = "https://www.nuscenes.org/terms-of-use"


def download_job(config: Config) -> DownloadJob:
    """The download for the first recorded dataset of version v1.0-mini. Raises ConfigError if there is none."""
    for name, dataset in config.datasets.items():
        if (dataset.reader, dataset.version, dataset.world) == ("nuscenes", VERSION, None):
            return DownloadJob(
                accept_nuscenes_terms=config.accept_nuscenes_terms,
                dataset=name,
                dataroot=dataset.dataroot,
                version=dataset.version,
                nuscenes_mini=config.nuscenes_mini,
            )
    raise ConfigError(f"no recorded dataset of version {VERSION} is in the config to download it for")


def require_permission(job: DownloadJob) -> None:
    """Raises ConfigError if the terms are not accepted, or the dataset's folder holds other data."""
    if not job.accept_nuscenes_terms:
        raise ConfigError(
            f"nuScenes comes under terms (non-commercial use, unless licensed): read {TERMS}, and where you accept "
            "them set accept_nuscenes_terms: true in config.yaml, or --config accept_nuscenes_terms=True"
        )
    root = dataroot(job)
    if not is_present(job) and root.exists() and not (root.is_dir() and not any(root.iterdir())):
        raise ConfigError(
            f"{root} is to hold nuScenes {job.version}, but holds something else, or only a part of it: "
            f"set another datasets.{job.dataset}.dataroot, or empty that folder"
        )


def dataroot(job: DownloadJob) -> Path:
    """The folder that is to hold the dataset."""
    return Path(job.dataroot).expanduser().resolve()


def is_present(job: DownloadJob) -> bool:
    """Whether all tables of the dataset are present."""
    try:
        layout.all_tables(layout.find_root(job.dataroot, job.version), job.version)
    except DatasetError:
        return False
    return True
