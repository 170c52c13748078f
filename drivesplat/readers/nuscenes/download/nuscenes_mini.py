"""The rule `download_nuscenes_mini`: the archive fetched and checked, unpacked beside the dataset's folder, and moved
there as a whole. A run that is killed anywhere is gone on with by the next one."""

import fcntl
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.readers.datasets import layout
from drivesplat.readers.nuscenes.download.destination import dataroot, is_there, refuse
from drivesplat.readers.nuscenes.download.disk import require_space
from drivesplat.readers.nuscenes.download.fetch import fetch, part_of, size_of
from drivesplat.readers.nuscenes.download.progress import tell
from drivesplat.readers.nuscenes.download.unpack import BadArchiveError, Limits, unpack
from drivesplat.settings.download import DownloadJob

log = logging.getLogger(__name__)

ARCHIVE, UNPACKED = "v1.0-mini.tgz", "unpacked"


def download(job: DownloadJob) -> None:
    """Makes sure that nuScenes mini is at the dataroot; does nothing where it is there.

    Raises ConfigError where it may not be fetched, DatasetError where it cannot be; a line each.
    """
    refuse(job)
    root = dataroot(job)
    if is_there(job):
        tell(f"nuScenes {job.version} is in {job.dataroot} already: nothing to do")
        return
    folder = work_folder(job)
    try:
        with _held(folder):
            if not is_there(job):  # another run may have been faster
                shutil.rmtree(folder / UNPACKED, ignore_errors=True)  # of a run that was killed
                _require_space(job, folder)
                _bring(job, folder, root)
            _clear(folder, job.nuscenes_mini.keep_archive)
    except OSError as error:
        where = error.filename or folder
        raise DatasetError(
            f"{where}: {error.strerror or error}; free space, fix its permissions, or set another dataroot"
        ) from error
    tell(f"nuScenes {job.version} is in {root}")


def work_folder(job: DownloadJob) -> Path:
    """Beside the dataset's folder: the archive, whole or in part, and what is unpacked of it."""
    root = dataroot(job)
    return root.with_name(f"{root.name}.download")


def _require_space(job: DownloadJob, folder: Path) -> None:
    source, archive = job.nuscenes_mini, folder / ARCHIVE
    have = size_of(archive) or size_of(part_of(archive))
    fetched = max(source.size_bytes - have, 0)
    require_space(folder, fetched + round(source.max_unpacked_gb * 1e9), "nuScenes mini")


def _bring(job: DownloadJob, folder: Path, root: Path) -> None:
    source, archive = job.nuscenes_mini, folder / ARCHIVE
    if source.sha256 is None:
        log.warning(
            "nuscenes_mini.sha256 is null: of the archive from %s the size alone is checked, not the content",
            source.url,
        )
    fetch(source, archive)
    limits = Limits(round(source.max_unpacked_gb * 1e9), source.max_files)
    tables = [f"{job.version}/{table}.json" for table in layout("nuscenes").TABLES]
    try:
        unpack(archive, folder / UNPACKED, limits, tables)
    except BadArchiveError as error:
        archive.unlink()
        raise DatasetError(f"{source.url}: {error}; it has been removed") from error
    os.sync()
    (folder / UNPACKED).rename(root)  # takes the place of an empty folder, of nothing else


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Keeps a second run out of the folder until this one ends, however it ends. Raises DatasetError."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / "lock", "w", encoding="utf-8") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DatasetError(f"another run is downloading into {folder}; wait for it") from None
        yield


def _clear(folder: Path, keep_archive: bool) -> None:
    if keep_archive and (folder / ARCHIVE).is_file():
        tell(f"the archive is kept: {folder / ARCHIVE}")
        (folder / "lock").unlink()
    else:
        shutil.rmtree(folder, ignore_errors=True)  # a run that was faster may have removed it
