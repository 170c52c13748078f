"""A tiny drive packed as nuScenes packs its own, and a local server that sends it, well or badly."""

import hashlib
import io
import re
import tarfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

from drivesplat.settings.download import DownloadJob, NuscenesMiniSettings
from helpers.patience import PATIENCE_S


def packed(root: Path) -> bytes:
    """What lies in `root` as a .tgz."""
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as tar:
        for path in sorted(root.iterdir()):
            tar.add(path, arcname=path.name)
    return content.getvalue()


@dataclass
class Site:
    """What the server sends. `asked` holds the requests' headers; the settings below make it a bad one."""

    content: bytes
    tag: str | None = '"first"'
    ranges: bool = True
    length: int | None = None
    """What it announces instead of the true length; -1: nothing."""
    cut_after: list[int] = field(default_factory=list)
    """After how many bytes the next connections break off, one each."""
    silent_after: int | None = None
    trickle_s: float | None = None
    """Seconds between two bytes."""
    headers_trickle: bool = False
    """Whether the headers arrive so, too."""
    status: int = 200
    wrong_range: bool = False
    heeds_conditions: bool = True
    """Whether it looks at If-Range."""
    range_error: bool = False
    """Whether it answers 416 to who asks for a part."""
    asked: list[dict[str, str]] = field(default_factory=list)
    address: str = ""
    ended: threading.Event = field(default_factory=threading.Event)

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        self.asked.append(dict(handler.headers.items()))
        status = 416 if self.range_error and "Range" in handler.headers else self.status
        if status >= 400:
            handler.send_error(status)
            return
        start = self._start(handler)
        body = self.content[start:]
        handler.send_response(206 if start else self.status)
        if self.tag:
            handler.send_header("ETag", self.tag)
        if start:
            first = start + 1 if self.wrong_range else start
            handler.send_header("Content-Range", f"bytes {first}-{len(self.content) - 1}/{len(self.content)}")
        if self.length != -1:
            handler.send_header("Content-Length", str(len(body) if self.length is None else self.length))
        if self.headers_trickle:
            self._trickle(handler, b"HTTP/1.1 200 OK\r\n" + 200 * b"X-Padding: 1\r\n")
            return
        handler.end_headers()
        if self.trickle_s is not None and not self._trickle(handler, body):
            return
        if self.silent_after is not None:
            handler.wfile.write(body[: self.silent_after])
            self.ended.wait(PATIENCE_S)
            return
        handler.wfile.write(body[: self.cut_after.pop(0)] if self.cut_after else body)

    def _trickle(self, handler: BaseHTTPRequestHandler, content: bytes) -> bool:
        """Sends a byte at a time. Whether it came to the end."""
        for place in range(len(content)):
            with suppress(OSError):  # the client has left
                handler.wfile.write(content[place : place + 1])
            if self.ended.wait(self.trickle_s):
                return False
        return True

    def _start(self, handler: BaseHTTPRequestHandler) -> int:
        """Where its answer begins: a condition that does not hold makes it send all."""
        wanted = re.fullmatch(r"bytes=(\d+)-", handler.headers.get("Range", ""))
        condition = handler.headers.get("If-Range")
        same = condition is None or not self.heeds_conditions or condition == self.tag
        return int(wanted[1]) if wanted and self.ranges and same else 0

    @property
    def ranges_asked(self) -> list[str | None]:
        return [headers.get("Range") for headers in self.asked]

    def settings(self, **changed) -> NuscenesMiniSettings:
        """The settings that this site's archive fits."""
        fitting = {
            "url": self.address, "size_bytes": len(self.content), "timeout_s": 5.0, "max_unpacked_gb": 0.1,
            "sha256": hashlib.sha256(self.content).hexdigest(),
        }  # fmt: skip
        return NuscenesMiniSettings(**{**fitting, **changed})

    def job(self, dataroot: Path, **changed) -> DownloadJob:
        return DownloadJob(
            accept_nuscenes_terms=True, dataset="nuscenes", dataroot=str(dataroot), version="v1.0-mini",
            nuscenes_mini=self.settings(**changed),
        )  # fmt: skip


@contextmanager
def served(site: Site) -> Iterator[Site]:
    """The site with its address, as long as the context lasts."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            site.answer(self)

        def log_message(self, *_):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    site.address = f"http://127.0.0.1:{server.server_address[1]}/v1.0-mini.tgz"
    try:
        yield site
    finally:
        site.ended.set()
        server.shutdown()
        server.server_close()
        thread.join()
