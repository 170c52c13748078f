"""A large file over HTTP, resumed where an earlier call was cut off.

{name}.part holds the received bytes, {name}.part.json the server's validator of the file (ETag or Last-Modified). A
call requests the rest with `Range` and `If-Range`. A server that sends the whole file instead, because it supports no
ranges or because the file has changed, restarts the download (RFC 9110, 13.1.5 and 14.2).
"""

import errno
import http.client
import json
import os
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from contextlib import suppress
from email.message import Message
from pathlib import Path
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.io.storage import sha256_file, write_json
from drivesplat.readers.nuscenes.download.console import announce, byte_progress
from drivesplat.settings.download import NuscenesMiniSettings

CHUNK = 1 << 20
PAUSE_S = 2.0
"""Pause in seconds between two connections."""
MIN_NEW_BYTES = 1 << 20
"""A connection that brings fewer bytes counts as failed."""
TRANSIENT = (408, 416, 429, 500, 502, 503, 504)
"""HTTP errors after which another connection may succeed."""
DISK_ERRORS = (errno.EACCES, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.ENOSPC, errno.EPERM, errno.EROFS)


def part_of(path: Path) -> Path:
    """The file of the bytes received so far."""
    return path.with_name(f"{path.name}.part")


def size_of(path: Path) -> int:
    """A file's size in bytes, 0 if there is none."""
    return path.stat().st_size if path.is_file() else 0


def fetch(source: NuscenesMiniSettings, path: Path) -> None:
    """Ensures that a file of the right size and checksum is at `path`.

    Raises DatasetError, in one line, if that fails. The received bytes are kept for the next call. A wrong file is
    removed, unless the user put it at `path`.
    """
    part = part_of(path)
    if path.is_file():
        if mismatch := _mismatch(source, path):
            raise DatasetError(f"{path}: {mismatch}; remove the file, or change nuscenes_mini in config.yaml")
        return
    _complete(source, part)
    if mismatch := _mismatch(source, part):
        _discard(part)
        raise DatasetError(f"{source.url}: {mismatch}; it has been removed")
    part.replace(path)
    _discard(part)


def _mismatch(source: NuscenesMiniSettings, path: Path) -> str | None:
    """How size or checksum of a file differ from the settings; None if they do not."""
    size = size_of(path)
    if size != source.size_bytes:
        return f"the file has {size:,} bytes, nuscenes_mini.size_bytes says {source.size_bytes:,}"
    if source.sha256 is None:
        return None
    announce("checking the archive's SHA-256")
    digest = sha256_file(path)
    if digest != source.sha256:
        return f"the file's SHA-256 is {digest[:16]}…, nuscenes_mini.sha256 says {source.sha256[:16]}…"
    return None


def _complete(source: NuscenesMiniSettings, part: Path) -> None:
    """Connects until `part` is complete. Raises DatasetError after too many connections without new bytes."""
    if size_of(part) > source.size_bytes:
        _discard(part)
    most, failures, reason = size_of(part), 0, ""
    while size_of(part) < source.size_bytes and failures < source.attempts:
        if reason:
            announce(f"the download broke off ({reason}); going on")
            time.sleep(PAUSE_S)
        try:
            _connect(source, part)
            reason = "the server ended it early"
        except urllib.error.HTTPError as error:
            reason = f"HTTP {error.code} {error.reason}"
            if error.code == 416:
                _discard(part)
            if error.code not in TRANSIENT:
                break
        except (OSError, ValueError, http.client.HTTPException) as error:
            reason = " ".join(str(getattr(error, "reason", None) or error or type(error).__name__).split())
            if getattr(error, "errno", None) in DISK_ERRORS:
                why = f"cannot be written ({error.strerror})"
                raise DatasetError(f"{part}: {why}; free space or fix its permissions") from error
        failures = 0 if size_of(part) >= most + MIN_NEW_BYTES else failures + 1
        most = max(most, size_of(part))
    have = size_of(part)
    if have < source.size_bytes:
        kept = f"; {have:,} of {source.size_bytes:,} bytes are kept: run again, and it goes on" if have else ""
        raise DatasetError(f"{source.url} could not be fetched ({reason}){kept}")


def _connect(source: NuscenesMiniSettings, part: Path) -> None:
    """One connection: appends to `part` what the server sends. Raises DatasetError if its file has another size,
    ValueError if its range does not begin as requested, or belongs to another file."""
    validator = None
    with suppress(OSError, ValueError, AttributeError):
        validator = json.loads(_record_of(part).read_text(encoding="utf-8")).get(source.url)
    start, size = size_of(part) if validator else 0, source.size_bytes
    headers = {"User-Agent": "drivesplat", **({"Range": f"bytes={start}-", "If-Range": validator} if start else {})}
    request = urllib.request.Request(source.url, headers=headers)
    opener = urllib.request.build_opener(_HttpHandler, _HttpsHandler)
    with opener.open(request, timeout=source.timeout_s) as response:
        try:
            if response.status == 206:
                found = re.fullmatch(r"bytes (\d+)-\d+/(\d+)", response.headers.get("Content-Range", "").strip())
                if not found or int(found[1]) != start or _validator(response.headers) not in (None, validator):
                    raise ValueError("the server sent other bytes than requested")
                total = int(found[2])
            elif response.status == 200:
                length = response.headers.get("Content-Length")
                start, total = 0, None if length is None else int(length)
            else:
                raise ValueError(f"the server answered {response.status}")
        except ValueError:
            _discard(part)
            raise
        if total in (None, size) and _receive(source, response, part, start) <= size:
            return
    _discard(part)
    sent = f"more than {size:,}" if total in (None, size) else f"{total:,}"
    raise DatasetError(
        f"{source.url}: the server's file has {sent} bytes, nuscenes_mini.size_bytes says {size:,}; "
        "nothing of it is kept"
    )


def _receive(source: NuscenesMiniSettings, response: http.client.HTTPResponse, part: Path, start: int) -> int:
    """Writes the response to `part` from `start` on, up to a byte more than expected; returns the size of `part`.

    Raises TimeoutError if the server sends less than the least rate."""
    end = source.size_bytes + 1
    progress = byte_progress("download", source.size_bytes, start)
    with open(part, "r+b" if start else "wb") as file, progress:
        if not start:
            write_json(_record_of(part), {source.url: _validator(response.headers)})
        file.seek(start)
        since, from_byte = time.monotonic(), start
        while start < end and (chunk := response.read1(min(CHUNK, end - start))):
            file.write(chunk)
            file.flush()
            start += len(chunk)
            progress.update(len(chunk))
            if (seconds := time.monotonic() - since) >= source.timeout_s:
                if start - from_byte < source.min_kb_per_s * 1000 * seconds:
                    raise TimeoutError(f"slower than nuscenes_mini.min_kb_per_s, {source.min_kb_per_s:g} kB/s")
                since, from_byte = time.monotonic(), start
        os.fsync(file.fileno())
    return start


def _validator(headers: Message) -> str | None:
    """A header that changes with the file: a strong ETag, else Last-Modified (RFC 9110, 8.8)."""
    tag = headers.get("ETag")
    return tag if tag and not tag.startswith("W/") else headers.get("Last-Modified")


def _record_of(part: Path) -> Path:
    return part.with_name(f"{part.name}.json")


def _discard(part: Path) -> None:
    """Removes the bytes received so far."""
    part.unlink(missing_ok=True)
    _record_of(part).unlink(missing_ok=True)


class _Deadline:
    """For subclasses of HTTPConnection: `timeout` also limits the time until all headers have been received. A socket's
    timeout limits the silence between two packets, which a server that sends a byte at a time never exceeds."""

    def getresponse(self: Any) -> http.client.HTTPResponse:
        expired, sock = threading.Event(), self.sock

        def end() -> None:
            expired.set()
            with suppress(OSError):  # the server has closed it
                sock.shutdown(socket.SHUT_RDWR)

        timer = threading.Timer(self.timeout, end)
        timer.daemon = True
        timer.start()
        try:
            return super().getresponse()
        except (OSError, http.client.HTTPException) as error:
            if expired.is_set():
                raise TimeoutError(f"no complete answer within {self.timeout:g} s") from error
            raise
        finally:
            timer.cancel()


class _HttpConnection(_Deadline, http.client.HTTPConnection):
    pass


class _HttpsConnection(_Deadline, http.client.HTTPSConnection):
    pass


class _HttpHandler(urllib.request.HTTPHandler):
    def http_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_HttpConnection, request)


class _HttpsHandler(urllib.request.HTTPSHandler):
    def https_open(self, request: urllib.request.Request) -> http.client.HTTPResponse:
        return self.do_open(_HttpsConnection, request)
