"""A large file over HTTP, which goes on where an earlier call was cut off.

What has come lies in a file of its own, beside it what the server said of the file then. A call asks for the rest with
`Range`, on condition (`If-Range`) that the file is still the same; a server that sends all of it instead, be it that
it knows no ranges or that the file is another, starts the file over (RFC 9110, 13.1.5 and 14.2).
"""

import http.client
import json
import os
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.io.storage import sha256_file, write_json
from drivesplat.readers.nuscenes.download.progress import Progress, tell
from drivesplat.settings.download import NuscenesMiniSettings

CHUNK = 1 << 20
PAUSE_S = 2.0
"""Between two connections."""
NEWS = 1 << 20
"""A connection that brings fewer bytes than this has brought nothing."""
PASSING = (408, 416, 429, 500, 502, 503, 504)
"""Answers after which another connection may fare better."""


@dataclass(frozen=True)
class Mark:
    """What tells a file of a server's from a later one under the same address: a header of its answer, ETag or
    Last-Modified."""

    header: str
    value: str


def part_of(path: Path) -> Path:
    """The file that holds what has come so far."""
    return path.with_name(f"{path.name}.part")


def fetch(source: NuscenesMiniSettings, path: Path) -> None:
    """Makes sure that the file of the right size and checksum is at `path`.

    Raises DatasetError: in a line why that failed. What came of the right file is kept for the next call; a file that
    turns out wrong is removed, unless somebody else put it at `path`.
    """
    if path.is_file():
        wrong = _wrong(source, path)
        if wrong:
            raise DatasetError(f"{path}: {wrong}; remove the file, or change nuscenes_mini in config.yaml")
        return
    part = part_of(path)
    _bring(source, part)
    wrong = _wrong(source, part)
    if wrong:
        forget(part)
        raise DatasetError(f"{source.url}: {wrong}; it has been removed")
    part.replace(path)
    forget(part)


def forget(part: Path) -> None:
    """Removes what has come so far."""
    part.unlink(missing_ok=True)
    _record_of(part).unlink(missing_ok=True)


def size_of(path: Path) -> int:
    """A file's size in bytes, 0 where there is none."""
    return path.stat().st_size if path.is_file() else 0


def _wrong(source: NuscenesMiniSettings, path: Path) -> str | None:
    """In words what is wrong with the size or the checksum of a file; None where nothing is."""
    size = size_of(path)
    if size != source.size_bytes:
        return f"the file has {size:,} bytes, nuscenes_mini.size_bytes says {source.size_bytes:,}"
    if source.sha256 is None:
        return None
    tell("checking the archive's SHA-256")
    digest = sha256_file(path)
    if digest != source.sha256:
        return f"the file's SHA-256 is {digest[:16]}…, nuscenes_mini.sha256 says {source.sha256[:16]}…"
    return None


def _bring(source: NuscenesMiniSettings, part: Path) -> None:
    """Connects until `part` has its size, or until nothing new comes."""
    if size_of(part) > source.size_bytes:
        forget(part)
    most, failures, why = size_of(part), 0, ""
    while size_of(part) < source.size_bytes and failures < source.attempts:
        if why:
            tell(f"the download broke off ({why}); going on")
            time.sleep(PAUSE_S)
        try:
            _connect(source, part)
            why = "the server ended it early"
        except urllib.error.HTTPError as error:
            why = f"HTTP {error.code} {error.reason}"
            if error.code == 416:
                forget(part)
            if error.code not in PASSING:
                break
        except (OSError, ValueError, http.client.HTTPException) as error:
            why = " ".join(str(getattr(error, "reason", None) or error or type(error).__name__).split())
        failures = 0 if size_of(part) >= most + NEWS else failures + 1
        most = max(most, size_of(part))
    have = size_of(part)
    if have < source.size_bytes:
        kept = f"; {have:,} of {source.size_bytes:,} bytes are kept: run again, and it goes on" if have else ""
        raise DatasetError(f"{source.url} could not be fetched ({why}){kept}")


def _connect(source: NuscenesMiniSettings, part: Path) -> None:
    """One connection: adds to `part` until the server has no more to send."""
    mark = _remembered(source, part)
    start = size_of(part) if mark else 0
    headers = {"User-Agent": "drivesplat"}
    if mark and start:
        headers |= {"Range": f"bytes={start}-", "If-Range": mark.value}
    request = urllib.request.Request(source.url, headers=headers)
    with urllib.request.urlopen(request, timeout=source.timeout_s) as response:
        try:
            start = _agreed_start(response, start, mark, source.size_bytes)
        except _OtherSizeError as error:
            forget(part)
            raise _other_size(source, f"{error.args[0]:,}") from None
        except ValueError:
            forget(part)
            raise
        _write(source, response, part, start)


class _OtherSizeError(Exception):
    """The server's file has so many bytes, which are not those it should have."""


def _agreed_start(response: http.client.HTTPResponse, start: int, mark: Mark | None, size: int) -> int:
    """At which byte the server's answer begins: at `start`, which it was asked for, or at 0. Raises _OtherSizeError
    where it says that its file has another size, ValueError where it answers something that nobody asked for."""
    told = response.headers.get
    if response.status == 206:
        found = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", (told("Content-Range") or "").strip())
        if not found or not mark or int(found[1]) != start or told(mark.header, mark.value) != mark.value:
            raise ValueError("the server answered with other bytes than it was asked for")
        whole = found[2]
    elif response.status == 200:
        start, whole = 0, told("Content-Length")
    else:
        raise ValueError(f"the server answered {response.status}")
    if whole is not None and int(whole) != size:
        raise _OtherSizeError(int(whole))
    return start


def _other_size(source: NuscenesMiniSettings, size: str) -> DatasetError:
    return DatasetError(
        f"{source.url}: the server's file has {size} bytes, nuscenes_mini.size_bytes says {source.size_bytes:,}; "
        "nothing of it is kept"
    )


def _write(source: NuscenesMiniSettings, response: http.client.HTTPResponse, part: Path, start: int) -> None:
    """Writes the server's answer into `part` from `start` on. Raises DatasetError where the disk does not take it."""
    progress, have = Progress("download", source.size_bytes, start), start
    end = source.size_bytes if response.length is not None else source.size_bytes + 1
    with _on_disk(part, open, part, "r+b" if start else "wb", 0) as file:
        if not start:
            _remember(source, part, response)
        file.seek(start)
        while have < end and (chunk := response.read1(min(CHUNK, end - have))):
            have += len(chunk)
            progress.add(len(chunk))
            while chunk:
                chunk = chunk[_on_disk(part, file.write, chunk) :]
        _on_disk(part, os.fsync, file.fileno())
    if have > source.size_bytes:
        forget(part)
        raise _other_size(source, f"more than {source.size_bytes:,}")


def _on_disk(part: Path, do: Callable[..., Any], *arguments: Any) -> Any:
    """What `do` returns; its OSError is the disk's, not the network's, and becomes a DatasetError."""
    try:
        return do(*arguments)
    except OSError as error:
        raise DatasetError(
            f"{part}: cannot be written ({error.strerror or error}); free space or fix its permissions"
        ) from error


def _record_of(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _remember(source: NuscenesMiniSettings, part: Path, response: http.client.HTTPResponse) -> None:
    """Keeps the mark of the file that now comes. A weak ETag is none."""
    marks = {header: response.headers.get(header) for header in ("ETag", "Last-Modified")}
    good = {header: value for header, value in marks.items() if value and not value.startswith("W/")}
    write_json(_record_of(part), {"url": source.url, "marks": good})


def _remembered(source: NuscenesMiniSettings, part: Path) -> Mark | None:
    """The mark of the file whose first bytes have come; None where it cannot be gone on with."""
    with suppress(OSError, ValueError, LookupError, TypeError, AttributeError):
        record = json.loads(_record_of(part).read_text(encoding="utf-8"))
        if record["url"] == source.url:
            first, *_ = record["marks"].items()
            return Mark(*first)
    return None
