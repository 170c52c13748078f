"""Files that datasets share with other folders."""

import os
import shutil
from pathlib import Path


def link_or_copy(source: Path, target: Path) -> None:
    """Makes `target`, with its folder, a hard link to `source` where the file system allows it, otherwise a copy. An
    existing file is replaced, not written into: it may be a link, too."""
    target.parent.mkdir(parents=True, exist_ok=True)
    if target.exists() and target.samefile(source):
        return
    target.unlink(missing_ok=True)
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)
