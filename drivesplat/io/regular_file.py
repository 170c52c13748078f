"""A guard before a file that a user names is opened: a pipe or a device would be waited for or read for ever.

This module imports quickly, since the Snakefile imports it."""

import stat
from pathlib import Path

_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
}  # fmt: skip


def regular_file(path: str | Path, max_bytes: int | None = None) -> Path:
    """The path of a regular file, of at most `max_bytes` bytes; links are followed. Does not open it.

    Raises FileNotFoundError where there is nothing, and OSError, whose text says what it is instead, otherwise.
    """
    try:
        status = Path(path).stat()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as error:  # a circle of links, a folder without permission; a NUL in the path
        raise OSError(getattr(error, "strerror", None) or str(error)) from None
    kind = stat.S_IFMT(status.st_mode)
    if kind != stat.S_IFREG:
        raise OSError(f"it is {_KINDS.get(kind, 'no file')}, not a regular file")
    if max_bytes is not None and status.st_size > max_bytes:
        raise OSError(f"it has {status.st_size / 1e6:.0f} MB, more than {max_bytes / 1e6:.0f} MB")
    return Path(path)
