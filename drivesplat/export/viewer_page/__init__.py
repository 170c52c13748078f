"""The page of viewer.html: its template, and the scripts that stand in it one after the other."""

import re
from pathlib import Path

SCRIPTS = ("shaders.js", "order.js", "camera.js", "draw.js", "main.js")


def filled_page(**values: str) -> str:
    """The page with every {{name}} of its template filled in; what is filled in is not looked through again.

    The values are text of HTML; the scripts are not among them.
    """
    filling = {**values, "scripts": "\n".join(map(_text, SCRIPTS))}
    return re.sub(r"\{\{(\w+)\}\}", lambda found: filling[found[1]], _text("page.html"))


def _text(name: str) -> str:
    return Path(__file__).with_name(name).read_text(encoding="utf-8")
