"""The rule `download_nuscenes_mini`: downloads the archive, verifies it, unpacks it beside the dataset's folder, and
moves the result there as a whole. The next run resumes one that was killed."""

import logging
import os
import shutil
from pathlib import Path

from drivesplat.errors import DatasetError
from drivesplat.io.file_lock import LockHeldError, locked_file
from drivesplat.readers.nuscenes import layout
from drivesplat.readers.nuscenes.download.console import announce
from drivesplat.readers.nuscenes.download.destination import dataroot, is_present, require_permission
from drivesplat.readers.nuscenes.download.fetch import fetch, part_of, size_of
from drivesplat.readers.nuscenes.download.unpack import BadArchiveError, require_space, unpack
from drivesplat.settings.download import DownloadJob

log = logging.getLogger(__name__)

ARCHIVE, UNPACKED = "v1.0-mini.tgz", "unpacked"


def download(job: DownloadJob) -> None:
    """Ensures that nuScenes mini is at the dataroot; does nothing if it is there.

    Raises ConfigError if it may not be downloaded, DatasetError if that fails; one line each.
    """
    require_permission(job)
    if is_present(job):
        announce(f"nuScenes {job.version} is in {job.dataroot} already: nothing to do")
        return
    folder = work_folder(job)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with locked_file(folder / "lock"):
            if not is_present(job):  # another run may have finished first
                _fill(job, folder)
            if job.nuscenes_mini.keep_archive and (folder / ARCHIVE).is_file():
                announce(f"the archive is kept: {folder / ARCHIVE}")
                (folder / "lock").unlink()
            else:
                shutil.rmtree(folder, ignore_errors=True)  # another run may have removed it already
    except LockHeldError:
        raise DatasetError(f"another run is downloading into {folder}; wait for it") from None
    except OSError as error:
        where = error.filename or folder
        raise DatasetError(
            f"{where}: {error.strerror or error}; free space, fix its permissions, or set another dataroot"
        ) from error
    announce(f"nuScenes {job.version} is in {dataroot(job)}")


def work_folder(job: DownloadJob) -> Path:
    """The folder beside the dataset's, for the archive and its unpacked files."""
    root = dataroot(job)
    return root.with_name(f"{root.name}.download")


def _fill(job: DownloadJob, folder: Path) -> None:
    """Fetches and unpacks the archive in `folder`, and moves the result to the dataroot."""
    source, archive, unpacked = job.nuscenes_mini, folder / ARCHIVE, folder / UNPACKED
    shutil.rmtree(unpacked, ignore_errors=True)  # of a killed run
    missing = max(source.size_bytes - (size_of(archive) or size_of(part_of(archive))), 0)
    require_space(folder, missing + round(source.max_unpacked_gb * 1e9), "nuScenes mini")
    if source.sha256 is None:
        log.warning("nuscenes_mini.sha256 is null: only the size of %s is checked, not its content", source.url)
    fetch(source, archive)
    tables = [f"{job.version}/{table}.json" for table in layout.TABLES]
    try:
        unpack(archive, unpacked, source, tables)
    except BadArchiveError as error:
        archive.unlink()
        raise DatasetError(f"{source.url}: {error}; it has been removed") from error
    os.sync()
    unpacked.rename(dataroot(job))  # replaces an empty folder, and nothing else
