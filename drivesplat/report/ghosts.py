"""ghosts.html: the published fixes of ghosts and the project's document about them, as a page that needs no network."""

import re
from pathlib import Path

import markdown
from markupsafe import Markup

from drivesplat import WORKFLOW
from drivesplat.evaluation.published_fixes import GHOSTS_DOCUMENT, PUBLISHED_FIXES
from drivesplat.io.html_page import filled_page
from drivesplat.report import ghosts_page

_LINK = re.compile(r"\[([^\]\n]+)\]\((?!https?:)[^)\s]+\)")
"""A link to another document, which the page does not come with."""


def render_ghosts_page(document: Path | None = None) -> str:
    """The page; `document` is by default that of the workflow. Without it, the page names the published fixes only."""
    document = document or WORKFLOW / GHOSTS_DOCUMENT
    text = document.read_text(encoding="utf-8") if document.is_file() else ""
    content = markdown.markdown(_LINK.sub(r"\1", text), extensions=["tables", "sane_lists"])
    return filled_page(ghosts_page, fixes=PUBLISHED_FIXES, document=GHOSTS_DOCUMENT, content=Markup(content))
