"""docs/troubleshooting.md quotes messages of the code; links of README and docs/ lead to files and headings."""

import ast
import re
import textwrap
from pathlib import Path

import pytest
import yaml
from helpers import REPOSITORY

from drivesplat.settings.config import Config, load

PAGE = (REPOSITORY / "docs/troubleshooting.md").read_text(encoding="utf-8")
HEADINGS = re.findall(r"^### (.+)$", PAGE, re.M)
MESSAGES = [span for heading in HEADINGS for span in re.findall(r"`([^`]+)`", heading) if "…" in span or " " in span]
"""What is quoted: code in a heading, but for names of a setting or file."""


def spelled(node: ast.expr) -> str | None:
    """A string of the source, with … where it is filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%[-+0-9.]*[sdrf]", "…", node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(spelled(part) or "…" for part in node.values)
    return None


def strings() -> list[str]:
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in (REPOSITORY / "drivesplat").rglob("*.py"))
    return [text for tree in trees for node in ast.walk(tree) if isinstance(node, ast.expr) and (text := spelled(node))]


SOURCE = strings()


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_that_is_quoted_is_one_of_the_codes(message):
    """Its literal parts stand in one string of the source, in this order."""
    parts = [re.escape(part.strip()) for part in message.split("…") if part.strip(" ;:,")]
    assert parts and any(re.search(".*".join(parts), text, re.S) for text in SOURCE), message


def test_a_message_that_is_none_is_noticed():
    assert not any("no usable abacus" in text for text in SOURCE) and any(
        "no usable GPU: torch …" in text for text in SOURCE
    )
    assert len(MESSAGES) > 30


def anchor(heading: str) -> str:
    """As GitHub makes it of a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-")


def links() -> list[tuple[str, str]]:
    """Every link of the pages that does not leave the repository, with the page that has it."""
    pages = [REPOSITORY / name for name in ("README.md", "CHANGELOG.md", "THIRD_PARTY_NOTICES.md")]
    pages += [page for folder in ("docs", "archive") for page in sorted((REPOSITORY / folder).glob("*.md"))]
    found = {(str(page.relative_to(REPOSITORY)), link) for page in pages for link in _links(page)}
    return sorted((page, link) for page, link in found if "://" not in link)


def _links(page: Path) -> list[str]:
    return re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8"))


@pytest.mark.parametrize(("page", "link"), links())
def test_links_lead_to_files_and_their_headings(page, link):
    file, _, place = link.partition("#")
    target = (REPOSITORY / page).parent / file if file else REPOSITORY / page
    assert target.exists()
    if place:
        headings = re.findall(r"^#+ (.+)$", target.read_text(encoding="utf-8"), re.M)
        assert place in {anchor(heading) for heading in headings}


SETTINGS = re.findall(r"`(\w+: \{[^`]+)`|((?:^    \w+: \{.*\n)+)", PAGE, re.M)


@pytest.mark.parametrize("text", [span or block for span, block in SETTINGS])
def test_settings_to_copy_are_taken(text):
    load(yaml.safe_load(textwrap.dedent(text)))


def test_there_are_settings_to_copy():
    assert len(SETTINGS) > 5


def test_settings_that_it_names_exist():
    """Code like `train.cap_max`, from a section of the config on down."""
    schema = Config.model_json_schema()
    named = set(re.findall(r"`((?:train|images|masks|lidar_seed|device|datasets|actors|extract)\.[a-z_.]+)`", PAGE))
    named = {name for name in named if not name.endswith((".json", ".npz", ".pkl"))}
    assert len(named) > 10
    for path in named:
        assert known(schema, schema, path.split(".")), path


def known(schema: dict, at: dict, keys: list[str]) -> bool:
    if not keys:
        return True
    options = [at, *at.get("anyOf", []), *at.get("allOf", [])]
    options += [schema["$defs"][option["$ref"].rpartition("/")[2]] for option in options if "$ref" in option]
    return any(
        known(schema, option["properties"][keys[0]], keys[1:])
        for option in options
        if keys[0] in option.get("properties", {})
    )
