"""The page of viewer.html: its template, and the scripts that stand in it one after the other."""

from drivesplat.io import html_page

SCRIPTS = ("shaders.js", "order.js", "camera.js", "draw.js", "main.js")


def filled_page(**values: str) -> str:
    """The page with its template filled in, its scripts included: see `drivesplat.io.html_page`."""
    return html_page.filled_page(__file__, SCRIPTS, **values)
