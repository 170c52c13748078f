"""An archive out of the network, unpacked without trust.

All of it is looked at before anything is written: names, kinds, number and total size. Then it is unpacked with
Python's own `data` filter (PEP 706) as a second pair of eyes.
"""

import gzip
import tarfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from drivesplat.errors import DatasetError
from drivesplat.readers.nuscenes.download.disk import require_space
from drivesplat.readers.nuscenes.download.progress import Progress, tell

MAX_READ = 1 << 20
"""No header is larger: a tar file may announce names of gigabytes, which are read at once."""
MAX_PADDING = 64 << 20
PLAIN = (tarfile.REGTYPE, tarfile.AREGTYPE, tarfile.DIRTYPE)
CORRUPT = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError, ValueError, OverflowError, RecursionError)


class BadArchiveError(DatasetError):
    """An archive is damaged, or not what it should be."""


@dataclass(frozen=True)
class Limits:
    """What an archive may unpack to: bytes, and files and folders."""

    max_bytes: int
    max_members: int


class _Stream(gzip.GzipFile):
    """A decompressed archive that is read in small pieces only."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= MAX_READ:
            raise tarfile.ReadError("a header of absurd size")
        return super().read(size)


def unpack(archive: Path, folder: Path, limits: Limits, required: list[str]) -> None:
    """Unpacks a .tgz, in which the files `required` have to be, into `folder`, which is not there yet.

    Raises BadArchiveError where the archive is to blame, before anything is written; DatasetError where the disk is.
    """
    if not hasattr(tarfile, "data_filter"):
        raise DatasetError("this Python cannot unpack archives safely: take 3.11.4 or newer")
    tell("looking through the archive")
    try:
        size = _inspect(archive, limits, required)
    except CORRUPT as error:
        raise BadArchiveError(f"{archive.name} is damaged ({error})") from error
    require_space(folder, size, "unpacking nuScenes mini")
    folder.mkdir(parents=True)
    progress = Progress("unpacking", max(size, 1))
    with _Stream(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
        tar.extractall(folder, members=_told(tar, progress), filter="data")


def _told(tar: tarfile.TarFile, progress: Progress) -> Iterator[tarfile.TarInfo]:
    for member in tar:
        yield member
        progress.add(member.size)


def _inspect(archive: Path, limits: Limits, required: list[str]) -> int:
    """The bytes that an archive unpacks to. Raises BadArchiveError where it should not be unpacked, any of CORRUPT
    where it cannot be."""
    size, names = 0, set()
    with _Stream(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
        for number, member in enumerate(tar, start=1):
            why = _objection(member)
            if why:
                raise BadArchiveError(f"{archive.name} is refused: {member.name[:200]!r} {why}")
            name = str(PurePosixPath(member.name))
            if name in names and not member.isdir():
                raise BadArchiveError(f"{archive.name} is refused: {name[:200]!r} is in it twice")
            names.add(name)
            size += member.size
            if number > limits.max_members:
                raise BadArchiveError(
                    f"{archive.name} is refused: it holds more than {limits.max_members:,} files and folders "
                    "(nuscenes_mini.max_files)"
                )
            if size > limits.max_bytes:
                raise BadArchiveError(
                    f"{archive.name} is refused: it unpacks to more than {limits.max_bytes / 1e9:g} GB "
                    "(nuscenes_mini.max_unpacked_gb)"
                )
        _require_end(stream)
    absent = [name for name in required if name not in names]
    if absent:
        raise BadArchiveError(f"{archive.name} is refused: it is no such dataset, {', '.join(absent[:3])} is missing")
    return size


def _require_end(stream: _Stream) -> None:
    """Raises ReadError where more than padding follows: `tarfile` takes a broken header for the end of an archive.
    Reads on to where gzip's own checksum stands."""
    for _ in range(MAX_PADDING // MAX_READ):
        padding = stream.read(MAX_READ)
        if not padding:
            return
        if padding.strip(b"\0"):
            raise tarfile.ReadError("a broken header")
    raise tarfile.ReadError("there is no end to it")


def _objection(member: tarfile.TarInfo) -> str | None:
    """Why a member may not be unpacked; None where it may."""
    path = PurePosixPath(member.name)
    if path.is_absolute() or member.name.startswith("\\"):
        return "is an absolute path"
    if ".." in path.parts:
        return "leads out of the folder"
    if not member.name.isprintable() or "\\" in member.name:
        return "is no name for a file"
    if member.issym() or member.islnk():
        return f"is a link to {member.linkname[:200]!r}"
    if member.type not in PLAIN or member.issparse():
        return "is neither a file nor a folder"
    return None
