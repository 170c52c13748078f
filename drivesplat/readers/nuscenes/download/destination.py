"""Whether nuScenes mini may be fetched, for which dataset of the config, and whether its place is free.

Cheap to import: the Snakefile asks before any job runs.
"""

from pathlib import Path

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.readers.datasets import layout
from drivesplat.settings.config import Config
from drivesplat.settings.download import DownloadJob

RULE = "download_nuscenes_mini"
"""The rule that fetches it."""
READER, VERSION = "nuscenes", "v1.0-mini"
TERMS = "https://www.nuscenes.org/terms-of-use"


def download_job(config: Config) -> DownloadJob:
    """What to fetch, for the first recorded dataset of version v1.0-mini. Raises ConfigError where there is none."""
    for name, dataset in config.datasets.items():
        if (dataset.reader, dataset.version, dataset.world) == (READER, VERSION, None):
            return DownloadJob(
                accept_nuscenes_terms=config.accept_nuscenes_terms,
                dataset=name,
                dataroot=dataset.dataroot,
                version=dataset.version,
                nuscenes_mini=config.nuscenes_mini,
            )
    raise ConfigError(f"no recorded dataset of version {VERSION} is in the config: there is nowhere to put it")


def refuse(job: DownloadJob) -> None:
    """Raises ConfigError where the terms are not accepted, or the dataset's folder holds something else."""
    if not job.accept_nuscenes_terms:
        raise ConfigError(
            f"nuScenes comes under terms (non-commercial use, unless licensed): read {TERMS}, and where you accept "
            "them set accept_nuscenes_terms: true in config.yaml, or --config accept_nuscenes_terms=True"
        )
    if not is_there(job):
        _refuse_other_data(job)


def dataroot(job: DownloadJob) -> Path:
    """The folder that is to hold the dataset."""
    return Path(job.dataroot).expanduser().resolve()


def is_there(job: DownloadJob) -> bool:
    """Whether the dataset is complete already, as far as its tables tell."""
    files = layout(READER)
    try:
        files.table_files(files.find_root(job.dataroot, job.version), job.version)
    except DatasetError:
        return False
    return True


def _refuse_other_data(job: DownloadJob) -> None:
    root = dataroot(job)
    if root.exists() and not (root.is_dir() and not any(root.iterdir())):
        raise ConfigError(
            f"{root} is to hold nuScenes {job.version}, but holds something else, or only a part of it: "
            f"set another datasets.{job.dataset}.dataroot, or empty that folder"
        )
