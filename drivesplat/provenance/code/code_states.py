"""The states of files of code: any change of a file, even one that is undone, gives it another state."""

import os
from pathlib import Path

CODE_FILES = (".py", ".html", ".js")
State = tuple[int, int, int, int]


def code_states(folder: Path) -> dict[Path, State]:
    """The states of all files of code in a folder and the folders in it."""
    paths = (Path(place, name) for place, _, names in os.walk(folder) for name in names if name.endswith(CODE_FILES))
    return {path: state for path in paths if (state := file_state(path))}


def file_state(path: Path) -> State | None:
    """Inode, size, and times (ns) of the last changes of a file's content and of the file; None where it is absent."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_ino, found.st_size, found.st_mtime_ns, found.st_ctime_ns
