"""ZIP archives as USDZ wants them: members are stored without compression and begin at multiples of 64 bytes.

Equal members give equal archives: dates and permissions are constant. Readers refuse what could write outside a folder.
"""

import hashlib
import zipfile
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from drivesplat.io.storage import atomic_path

ALIGNMENT = 64
"""Bytes; the data of each member begins at a multiple of it."""
DATE = (1980, 1, 1, 0, 0, 0)
"""The date of all members, the first that ZIP knows."""
_PADDING = 0x1986
"""The header of the extra field that OpenUSD fills with padding."""
_CHUNK = 1 << 20


class ArchiveError(Exception):
    """What is wrong with an archive, as the end of a sentence."""


def write_aligned_zip(path: str | Path, members: Mapping[str, bytes | Path]) -> None:
    """Writes an archive of members, each by its content or by the file that has it, atomically.

    Raises ResultError naming `path` where the disk is full or the folder cannot be written.
    """
    with atomic_path(path) as aside, zipfile.ZipFile(aside, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            size = len(content) if isinstance(content, bytes) else content.stat().st_size
            with archive.open(_header(archive, name, size), "w") as member:
                if isinstance(content, bytes):
                    member.write(content)
                    continue
                with open(content, "rb") as file:
                    while chunk := file.read(_CHUNK):
                        member.write(chunk)


def _header(archive: zipfile.ZipFile, name: str, size: int) -> zipfile.ZipInfo:
    """The header of the next member, with padding up to the next multiple of ALIGNMENT."""
    header = zipfile.ZipInfo(name, DATE)
    header.create_system, header.external_attr, header.file_size = 3, 0o644 << 16, size
    header.compress_type, header.CRC = zipfile.ZIP_STORED, 0
    is_large = size * 1.05 > zipfile.ZIP64_LIMIT  # as ZipFile.open decides
    begin = archive.fp.tell() + len(header.FileHeader(is_large)) + 4
    padding = -begin % ALIGNMENT
    header.extra = _PADDING.to_bytes(2, "little") + padding.to_bytes(2, "little") + bytes(padding)
    return header


def open_archive(path: Path) -> zipfile.ZipFile:
    """An archive to read members from. Raises ArchiveError where the file is none, or where a member is compressed,
    stands twice, has a name that leads out of a folder, or says that it is larger than the archive."""
    try:
        archive = zipfile.ZipFile(path)
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise ArchiveError(f"is no readable archive ({error})") from None
    try:
        _require_harmless(archive, path.stat().st_size)
    except ArchiveError:
        archive.close()
        raise
    return archive


def _require_harmless(archive: zipfile.ZipFile, size: int) -> None:
    members = archive.infolist()
    for member in members:
        if not is_inside(member.orig_filename):
            raise ArchiveError(f"has a member {member.orig_filename!r}, whose name leads out of its folder")
        if member.compress_type != zipfile.ZIP_STORED:
            raise ArchiveError(f"has a compressed member {member.filename}, which a USDZ has not")
    if len({member.filename for member in members}) < len(members):
        raise ArchiveError("has a member twice")
    if sum(member.file_size for member in members) > size:
        raise ArchiveError("has members that are larger than the archive")


def is_inside(name: str) -> bool:
    """Whether a name with slashes is that of a file within a folder, on every system.

    >>> [is_inside(name) for name in ("a/b.npz", "../b.npz", "/b.npz", "a\\\\b.npz", "c:b.npz")]
    [True, False, False, False, False]
    """
    parts = PurePosixPath(name).parts
    strange = any(character in name for character in "\\:\0")
    return bool(parts) and not strange and not name.startswith("/") and ".." not in parts


def read_member(archive: zipfile.ZipFile, name: str, max_bytes: int) -> bytes:
    """The content of a member of at most so many bytes. Raises ArchiveError where it is missing, larger or damaged."""
    try:
        if archive.getinfo(name).file_size > max_bytes:
            raise ArchiveError(f"has a member {name} of more than {max_bytes} bytes")
        return archive.read(name)
    except KeyError:
        raise ArchiveError(f"lacks {name}") from None
    except (zipfile.BadZipFile, OSError, EOFError, ValueError, RuntimeError, NotImplementedError) as error:
        raise ArchiveError(f"has a damaged member {name} ({error})") from None


def copy_member(archive: zipfile.ZipFile, name: str, path: Path) -> str:
    """Writes a member to a new file, and returns the SHA-256 of its content. Raises ArchiveError where the member is
    missing or damaged, OSError where the file cannot be written."""
    digest = hashlib.sha256()
    try:
        member = archive.open(name)
    except KeyError:
        raise ArchiveError(f"lacks {name}") from None
    except (zipfile.BadZipFile, OSError, ValueError, RuntimeError, NotImplementedError) as error:
        raise ArchiveError(f"has a damaged member {name} ({error})") from None
    with member, open(path, "xb") as file:
        while True:
            try:
                chunk = member.read(_CHUNK)
            except (zipfile.BadZipFile, EOFError) as error:
                raise ArchiveError(f"has a damaged member {name} ({error})") from None
            if not chunk:
                return digest.hexdigest()
            digest.update(chunk)
            file.write(chunk)
