"""Links of the pages in an unpacked archive, found without a browser."""

import json
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

NO_FILES = ("data:", "javascript:", "mailto:", "#")


class _Addresses(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, _: str, attributes: list[tuple[str, str | None]]) -> None:
        self.found += [value for name, value in attributes if name in ("href", "src", "poster") and value]


def addresses(html: str) -> list[str]:
    """The value of every href, src and poster."""
    parser = _Addresses()
    parser.feed(html)
    return parser.found


def addresses_in_results(page: str) -> list[str]:
    """The addresses of the results that Snakemake's report shows by script, and those in their captions."""
    start = page.index("results = {") + len("results = ")
    results, _ = json.JSONDecoder().raw_decode(page[start:])
    captions = [address for result in results.values() for address in addresses(result["caption"])]
    return [*(result["data_uri"] for result in results.values()), *captions]


def dead_links(folder: Path) -> tuple[set[str], int]:
    """The links of all pages below `folder` to anything but a file below it, as 'page: address'; and the number of
    links to files."""
    dead, links = set(), 0
    for page in folder.rglob("*.html"):
        text = page.read_text(encoding="utf-8")
        found = addresses(text) + (addresses_in_results(text) if page.name == "report.html" else [])
        for address in (address for address in found if not address.startswith(NO_FILES)):
            parts, links = urlsplit(address), links + 1
            target = (page.parent / unquote(parts.path)).resolve()
            outside = parts.scheme or parts.netloc or not target.is_relative_to(folder.resolve())
            if outside or not target.is_file():
                dead.add(f"{page.relative_to(folder)}: {address}")
    return dead, links
