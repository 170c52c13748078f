"""The stage `lpips_backbone`: AlexNet's weights, downloaded once or supplied by the user."""

import hashlib
import http.client
import logging
import urllib.request
from pathlib import Path
from typing import Any

from drivesplat.errors import DriveSplatError
from drivesplat.io.storage import atomic_write, read_record, sha256_file
from drivesplat.settings.evaluate import LpipsSettings

log = logging.getLogger(__name__)

MAX_BYTES = 1_000_000_000
CHUNK = 1 << 20


def provide_backbone(settings: LpipsSettings, path: Path) -> dict[str, Any]:
    """Downloads the backbone to `path` unless it is there. Returns a record with `file`, `sha256`, and `unavailable`
    (None, or the reason in one line).

    Raises nothing for a missing network or a wrong file: LPIPS is then null, with the reason. A user's file with
    another checksum is reported and stays; a downloaded one is not kept.
    """
    reason = None
    if not path.is_file():
        try:
            content = _download(settings)
            with atomic_write(path) as file:
                file.write(content)
        except (OSError, ValueError, http.client.HTTPException, DriveSplatError) as error:
            why = " ".join(str(getattr(error, "reason", None) or error or type(error).__name__).split())
            reason = (
                f"the AlexNet backbone could not be fetched from {settings.url} ({why}); "
                f"put the file at {path} yourself, then run again"
            )
    digest = sha256_file(path) if path.is_file() else None
    if digest is not None and not digest.startswith(settings.sha256):
        reason = f"{path} has SHA-256 {digest[:16]}…, lpips.sha256 says {settings.sha256}: replace the file"
    if reason:
        log.warning("LPIPS will be null: %s", reason)
    return {"file": str(path), "sha256": digest, "unavailable": reason}


def read_backbone(path: str | Path) -> dict[str, Any]:
    """Reads the record of `provide_backbone`. Raises ResultError if it is invalid."""
    return read_record(path, "lpips_backbone", "file", "sha256", "unavailable")


def _download(settings: LpipsSettings) -> bytes:
    """The complete and verified file at `settings.url`. Raises OSError, ValueError or HTTPException."""
    content = bytearray()
    with urllib.request.urlopen(settings.url, timeout=settings.timeout_s) as response:
        while chunk := response.read(CHUNK):
            content += chunk
            if len(content) > MAX_BYTES:
                raise ValueError(f"it is larger than {MAX_BYTES:,} bytes")
        expected = response.headers.get("Content-Length")
    if expected is not None and len(content) != int(expected):
        raise ValueError(f"it ended after {len(content):,} of {int(expected):,} bytes")
    digest = hashlib.sha256(content).hexdigest()
    if not digest.startswith(settings.sha256):
        raise ValueError(f"its SHA-256 is {digest[:16]}…, not {settings.sha256}")
    return bytes(content)
