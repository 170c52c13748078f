"""The page of gap_report.html: its template with its style, and its script."""

from drivesplat.io import html_page


def filled_page(**values: str) -> str:
    """The page with its template filled in, its script included: see `drivesplat.io.html_page`."""
    return html_page.filled_page(__file__, ["page.js"], **values)
