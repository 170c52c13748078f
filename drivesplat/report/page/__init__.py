"""The page of gap_report.html: its template with its style, and its script."""

import re
from pathlib import Path


def filled_page(**values: str) -> str:
    """The page with every {{name}} of its template filled in; what is filled in is not looked through again.

    The values are text of HTML; the script is not among them.
    """
    filling = {**values, "script": _text("page.js")}
    return re.sub(r"\{\{(\w+)\}\}", lambda found: filling[found[1]], _text("page.html"))


def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
