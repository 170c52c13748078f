"""An untrusted archive, checked in full (names, types, number, total size) before it is unpacked.

Unpacking applies Python's `data` filter (PEP 706) as a second check.
"""

import gzip
import tarfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

from tqdm import tqdm

from drivesplat.errors import DatasetError
from drivesplat.io.free_disk import disk_of, free_bytes
from drivesplat.readers.nuscenes.download.console import announce, byte_progress
from drivesplat.settings.download import NuscenesMiniSettings

MAX_READ = 1 << 20
"""Maximum size of a header and of the padding: a tar file may declare names of gigabytes, which `tarfile` reads
whole."""
MAX_DEPTH, MAX_PATH = 32, 1000
"""Maximum number of folders and of bytes in the path of a member."""
MAX_MTIME = 1 << 33
"""Maximum time of a member (seconds since 1970: the year 2242)."""
DAMAGED = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError, ValueError, OverflowError, RecursionError)


class BadArchiveError(DatasetError):
    """An archive is damaged or unsafe."""


class _Stream(gzip.GzipFile):
    """A decompressed archive that refuses large reads."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= MAX_READ:
            raise tarfile.ReadError("a header of absurd size")
        return super().read(size)


def unpack(archive: Path, folder: Path, limits: NuscenesMiniSettings, required: list[str]) -> None:
    """Unpacks a .tgz that contains the files `required` into `folder`, which must not exist.

    Raises BadArchiveError, before anything is written, if the archive is damaged, unsafe or over the limits;
    DatasetError if the disk has too little space.
    """
    if not hasattr(tarfile, "data_filter"):
        raise DatasetError("this Python cannot unpack archives safely: use 3.11.4 or newer")
    announce("checking the archive")
    try:
        size = _inspect(archive, limits, required)
    except DAMAGED as error:
        raise BadArchiveError(f"{archive.name} is damaged ({error})") from error
    require_space(folder, size, "unpacking nuScenes mini")
    folder.mkdir(parents=True)
    progress = byte_progress("unpacking", size)
    with _Stream(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar, progress:
        tar.extractall(folder, members=_counted(tar, progress), filter="data")


def require_space(folder: Path, needed: int, what: str) -> None:
    """Raises DatasetError if the disk of `folder` has less than `needed` bytes free."""
    free = free_bytes(folder)
    if free < needed:
        raise DatasetError(
            f"{what} needs {needed / 1e9:.1f} GB on the disk of {disk_of(folder)}, which has {free / 1e9:.1f} GB free: "
            "make room, or set a dataroot on another disk"
        )


def _counted(tar: tarfile.TarFile, progress: tqdm) -> Iterator[tarfile.TarInfo]:
    for member in tar:
        yield member
        progress.update(member.size)


def _inspect(archive: Path, limits: NuscenesMiniSettings, required: list[str]) -> int:
    """The unpacked size of an archive in bytes. Raises BadArchiveError if it is unsafe, any of DAMAGED if it cannot be
    read to its end."""
    size, names, files, folders = 0, set(), set(), set()
    with _Stream(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
        for count, member in enumerate(tar, start=1):
            name, why = str(PurePosixPath(member.name)), _objection(member)
            if not why and name in names and not member.isdir():
                why = "is in it twice"
            above = {str(folder) for folder in PurePosixPath(name).parents}
            if not why and (files & above or (member.isfile() and name in folders)):
                why = "is both a file and a folder"
            if why:
                raise BadArchiveError(f"{archive.name} is refused: {member.name[:200]!r} {why}")
            names.add(name)
            folders |= above
            files |= {name} if member.isfile() else set()
            size += member.size
            if count > limits.max_files:
                why = f"holds more than {limits.max_files:,} files and folders (nuscenes_mini.max_files)"
            elif size > limits.max_unpacked_gb * 1e9:
                why = f"unpacks to more than {limits.max_unpacked_gb:g} GB (nuscenes_mini.max_unpacked_gb)"
            if why:
                raise BadArchiveError(f"{archive.name} is refused: it {why}")
        # gzip verifies its checksum at the end; `tarfile` takes a broken header for the end of an archive.
        padding = stream.read(MAX_READ)
        if padding.strip(b"\0"):
            raise tarfile.ReadError("a broken header")
        if len(padding) == MAX_READ:
            raise tarfile.ReadError("there is no end to it")
    absent = [name for name in required if name not in names]
    if absent:
        raise BadArchiveError(f"{archive.name} is refused: it is no such dataset, {', '.join(absent[:3])} is missing")
    return size


def _objection(member: tarfile.TarInfo) -> str | None:
    """Why a member must not be unpacked; None if it may."""
    path = PurePosixPath(member.name)
    if path.is_absolute() or ".." in path.parts or "\\" in member.name or not member.name.isprintable():
        return "is no safe path for a file"
    if member.type not in (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.DIRTYPE) or member.issparse():
        return "is neither a file nor a folder"
    if len(path.parts) > MAX_DEPTH or len(member.name.encode(errors="replace")) > MAX_PATH:
        return "has a path of absurd length"
    if member.size < 0 or not 0 <= member.mtime < MAX_MTIME:
        return "has an impossible size or time"
    return None
