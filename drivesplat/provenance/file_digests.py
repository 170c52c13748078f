"""Digests of the files that rules read and write: a file that was altered after its rule wrote it is refused.

Beside every output lies `.digests/<name>.json`: the rule, the digest of the output, those of its members (files in its
folder that no rule declares, such as the masks beside masks.json) and those of the inputs it was made from. The record
of scene.json also holds the digests of the dataset's images and sweeps as `extract` checked them.

A file without a record is accepted with a warning: it was copied without the hidden folder, and may be valid.
"""

import hashlib
import logging
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from drivesplat.errors import ResultError
from drivesplat.io.storage import read_record, unreadable, write_json

log = logging.getLogger(__name__)

FOLDER = ".digests"
WITH_MEMBERS = ("masks.json", "parts.json", "truth.json", "drive.json", "scans.json", "splats.json")
"""Outputs whose rule also writes undeclared files into their folder."""
DIGEST_BYTES = 16
ALTERED = "its content is not what the rule wrote"


def file_digest(path: str | Path) -> str:
    """The BLAKE2b digest of a file's content, 32 hexadecimal digits. Raises OSError where it cannot be read."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, lambda: hashlib.blake2b(digest_size=DIGEST_BYTES)).hexdigest()


def file_digests(paths: Iterable[str | Path]) -> dict[str, str]:
    """The digests of files by path. Raises OSError where one cannot be read."""
    names = [str(path) for path in paths]
    with ThreadPoolExecutor() as pool:
        return dict(zip(names, pool.map(file_digest, names), strict=True))


def member_states(output: str | Path) -> dict[str, tuple[int, int]]:
    """Inode and modification time (ns) of every file in the folder of an output with members, by path from there."""
    path = Path(output)
    if path.name not in WITH_MEMBERS:
        return {}
    others = (file for file in path.parent.rglob("*") if file.is_file() and FOLDER not in file.parts and file != path)
    states = ((file, file.stat()) for file in others)
    return {file.relative_to(path.parent).as_posix(): (stat.st_ino, stat.st_mtime_ns) for file, stat in states}


def record_output(
    output: str | Path,
    rule: str,
    before: dict[str, tuple[int, int]],
    read: dict[str, str],
    dataset: dict[str, dict[str, str]] | None = None,
) -> None:
    """Writes the digests of an output. `before` are its `member_states` when the rule began, `read` the digests of the
    rule's inputs, `dataset` those of the dataset's files by kind. Raises ResultError where the record cannot be
    written."""
    path = Path(output)
    members = [name for name, state in member_states(path).items() if before.get(name) != state]
    digests = file_digests(path.parent / name for name in members)
    record: dict[str, Any] = {
        "rule": rule,
        "digest": file_digest(path),
        "members": dict(zip(members, digests.values(), strict=True)),
        "read": read,
    }
    write_json(_record_path(path), record | ({"dataset": dataset} if dataset else {}))


def checked_digest(path: str | Path, warn: bool = True) -> str:
    """The digest of a rule's output, after comparing it and its members with their record.

    A file without a record is accepted, with a warning if `warn`. Raises ResultError naming the altered or missing file
    and the rule that rebuilds it.
    """
    path = Path(path)
    record = _read_record(path)
    try:
        digest = file_digest(path)
    except OSError as error:
        why = f"cannot be read ({error.strerror or error})"
        if record is not None:
            raise unreadable(path, record["rule"], why) from error
        if isinstance(error, FileNotFoundError):
            raise
        raise ResultError(f"{path}: {why}; delete it and rerun: its rule rebuilds it") from error
    if record is None:
        if warn:
            log.warning("%s: no digest was recorded (copied without %s/?); its content is not checked", path, FOLDER)
        return digest
    if digest != record["digest"]:
        raise unreadable(path, record["rule"], ALTERED)
    members = {path.parent / name: expected for name, expected in record["members"].items()}
    for member in members:
        if not member.is_file():
            raise unreadable(member, record["rule"], "missing", delete=path)
    for (member, expected), found in zip(members.items(), file_digests(members).values(), strict=True):
        if found != expected:
            raise unreadable(member, record["rule"], ALTERED, delete=path)
    return digest


def check_dataset(scene_folder: str | Path, kinds: Iterable[str]) -> None:
    """Compares the dataset's files of some `kinds` ('images', 'sweeps') with those that `extract` read for the scene
    whose results are in `scene_folder`; missing ones are left to their readers. Raises ResultError naming the file."""
    scene = Path(scene_folder) / "scene.json"
    recorded = (_read_record(scene) or {}).get("dataset", {})
    expected = {path: digest for kind in kinds for path, digest in recorded.get(kind, {}).items()}
    for path, digest in file_digests(path for path in expected if Path(path).is_file()).items():
        if digest != expected[path]:
            raise ResultError(
                f"{path}: changed since the rule 'extract' read it; restore it, or delete {scene} and rerun: "
                "the rule 'extract' reads it again"
            )


def _record_path(path: Path) -> Path:
    return path.parent / FOLDER / f"{path.name}.json"


def _read_record(path: Path) -> dict[str, Any] | None:
    """The record of an output, None where there is none. Raises ResultError where it is damaged."""
    record_path = _record_path(path)
    if not record_path.exists():
        return None
    try:
        record = read_record(record_path, "", "rule", "digest", "members", "read")
        if not isinstance(record["members"], dict):
            raise ResultError("no table of members")
    except ResultError as error:
        raise ResultError(
            f"{record_path}: not a record of digests; delete {path} and rerun: its rule rebuilds both"
        ) from error
    return record
