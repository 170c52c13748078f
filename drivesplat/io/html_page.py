"""Pages of HTML from templates that lie beside a package's modules."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from drivesplat.io.storage import canonical_json


def filled_page(package: str, scripts: Sequence[str], **values: str) -> str:
    """The page.html beside the file `package` with every {{name}} in it filled in; what is filled in is not looked
    through again.

    The values are text of HTML; {{scripts}} are the files of these names there, one after the other.
    """
    folder = Path(package).parent
    filling = {**values, "scripts": "\n".join(_text(folder / name) for name in scripts)}
    return re.sub(r"\{\{(\w+)\}\}", lambda found: filling[found[1]], _text(folder / "page.html"))


def json_in_html(value: Any) -> str:
    """A value as JSON that cannot end the HTML element around it."""
    return canonical_json(value).replace("<", "\\u003c")


def _text(path: Path) -> str:
    return path.read_text(encoding="utf-8")
