"""A trained drive in one archive: the files that `open_drive` reads, and a list of them with their digests.

The archive is a scene for another program (`drivesplat.export.alpasim`), which ignores these members:

- drivesplat/manifest.json: a `PackedManifest`
- drivesplat/results/{scene}/...: the files, under their names below the folder of results
"""

import json
import shutil
import tempfile
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from drivesplat.errors import ResultError
from drivesplat.io.aligned_zip import ArchiveError, copy_member, is_inside, open_archive, read_member
from drivesplat.io.regular_file import regular_file
from drivesplat.io.storage import canonical_json, sha256_file, sha256_text, unwritable
from drivesplat.io.typed_record import field_values, typed_record

MANIFEST = "drivesplat/manifest.json"
FILES = "drivesplat/results/"
"""Members of an archive: the list of files, and what precedes the names of the files."""
METADATA = "metadata.yaml"
SCHEMA = 1
MAX_MANIFEST_BYTES, MAX_METADATA_BYTES = 64_000_000, 1_000_000


@dataclass(frozen=True)
class PackedManifest:
    """What an archive holds: the `method` and the `scene` that it was trained on, and the SHA-256 of `files` by their
    names below the folder of results, in which `folder` is that of the method."""

    schema: int
    scene: str
    method: str
    folder: str
    files: dict[str, Any]

    def fault(self) -> str | None:
        """What no manifest has, None without a fault."""
        if not all(isinstance(name, str) and isinstance(digest, str) for name, digest in self.files.items()):
            return "its list of files is damaged"
        if not all(is_inside(name) for name in (self.folder, *self.files)):
            return "its list of files leads out of its folder"
        return None if f"{self.folder}/checkpoint.npz" in self.files else "it lists no checkpoint"


def packed_members(folder: Path, scene: str, files: Iterable[Path]) -> dict[str, bytes | Path]:
    """The members of an archive for the drive of a method with the result folder `folder`: the `files` that opening it
    reads, which lie in it or beside it, and their list. Raises OSError where one cannot be read."""
    method, scene_folder = folder.absolute().name, folder.absolute().parent.name
    named = {}
    for file in files:
        own = file.is_relative_to(folder)
        below = Path(scene_folder, method) if own else Path(scene_folder)
        named[(below / file.relative_to(folder if own else folder.parent)).as_posix()] = file
    digests = {name: sha256_file(named[name]) for name in sorted(named)}
    manifest = PackedManifest(SCHEMA, scene, method, f"{scene_folder}/{method}", digests)
    content = canonical_json(field_values(manifest)).encode() + b"\n"
    return {MANIFEST: content, **{FILES + name: named[name] for name in sorted(named)}}


def unpack_drive(path: str | Path, cache: str | Path | None = None) -> Path:
    """Unpacks the drive in an archive, and returns the result folder of its method, for `drivesplat.open`.

    It lies in a folder of `cache` (by default ~/.cache/drivesplat/scenes) that is named by a digest of the files: a
    drive that is there already is not unpacked again, and several processes may unpack one at once. Folders in the
    cache can be deleted when no program uses them.

    Raises ResultError, one sentence that names the file, where it is missing, damaged, of another version or holds no
    drive, and where the cache cannot be written. Nothing is written outside the cache.
    """
    path = Path(path)
    place = Path.home() / ".cache" / "drivesplat" / "scenes" if cache is None else Path(cache)
    try:
        with open_archive(regular_file(path)) as archive:
            text = read_member(archive, MANIFEST, MAX_MANIFEST_BYTES)
            manifest = _manifest(text)
            folder = place / sha256_text(text.decode())[:32]
            sizes = {name: _size(archive, name) for name in manifest.files}
            if not _is_complete(folder, sizes):
                _unpack(archive, manifest, folder, sizes)
    except (ArchiveError, OSError, ValueError) as error:
        why = str(error) if isinstance(error, ArchiveError) else f"cannot be read ({error})"
        raise ResultError(f"{path}: {why}; export it again: the target 'alpasim' makes it") from None
    return folder / manifest.folder


def packed_scene_id(path: str | Path, checkpoint: Path | None = None) -> str | None:
    """The id by which a simulator knows the scene of an archive, `scene_id` of its metadata.yaml. None where the
    archive holds another training than the file `checkpoint`.

    Raises ResultError, one sentence that names the file, where it is missing, damaged or of another version.
    """
    path = Path(path)
    try:
        with open_archive(regular_file(path)) as archive:
            manifest = _manifest(read_member(archive, MANIFEST, MAX_MANIFEST_BYTES))
            found = yaml.safe_load(read_member(archive, METADATA, MAX_METADATA_BYTES))
        own = found.get("scene_id") if isinstance(found, dict) else None
        if not isinstance(own, str) or not own:  # what a few bytes of YAML repeat must not be written out
            raise ArchiveError(f"has a damaged {METADATA} (it has no scene_id)")
        packed = manifest.files[f"{manifest.folder}/checkpoint.npz"]
        return None if checkpoint is not None and sha256_file(checkpoint) != packed else own
    except (ArchiveError, OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        why = str(error) if isinstance(error, ArchiveError) else f"has a damaged {METADATA} ({error})"
        raise ResultError(f"{path}: {why}; export it again: the target 'alpasim' makes it") from None


def _manifest(text: bytes) -> PackedManifest:
    """The list of an archive's files. Raises ArchiveError for a damaged one, and one of another version."""
    try:
        content: Any = json.loads(text)
        if isinstance(content, dict) and content.get("schema") != SCHEMA:
            raise ArchiveError(f"is of version {content.get('schema')!r}, and this drivesplat reads version {SCHEMA}")
        return typed_record(PackedManifest, content, json=True)
    except (ValueError, RecursionError) as error:
        raise ArchiveError(f"has a damaged {MANIFEST} ({error})") from None


def _size(archive: zipfile.ZipFile, name: str) -> int:
    try:
        return archive.getinfo(FILES + name).file_size
    except KeyError:
        raise ArchiveError(f"lacks {FILES}{name}, which its manifest lists") from None


def _is_complete(folder: Path, sizes: dict[str, int]) -> bool:
    """Whether a folder has all files, by their sizes."""
    files = ((folder / name, size) for name, size in sizes.items())
    return all(file.is_file() and file.stat().st_size == size for file, size in files)


def _unpack(archive: zipfile.ZipFile, manifest: PackedManifest, folder: Path, sizes: dict[str, int]) -> None:
    """Fills a folder aside and renames it. Raises ArchiveError for a damaged file, ResultError where the cache cannot
    be written."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        aside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    except OSError as error:
        raise unwritable(folder.parent, error) from error
    try:
        for name, digest in manifest.files.items():
            target = aside / name
            target.parent.mkdir(parents=True, exist_ok=True)
            if copy_member(archive, FILES + name, target) != digest:
                raise ArchiveError(f"has a damaged member {FILES}{name} (its digest is another one)")
        if folder.exists() and not _is_complete(folder, sizes):
            shutil.rmtree(folder)
        try:
            aside.rename(folder)
        except OSError:
            if not _is_complete(folder, sizes):  # else another process was faster
                raise
    except OSError as error:
        raise unwritable(folder, error) from error
    finally:
        shutil.rmtree(aside, ignore_errors=True)
