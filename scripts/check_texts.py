"""Finds words that the project does not use, links that lead nowhere, and messages and settings that are only in the
documentation. `make lint` runs it:

    python -m scripts.check_texts

- Names and phrases of tests/forbidden_terms.txt, in code, comments, docstrings, strings and pages.
- Links of the pages, docs/*.md among them, to files and headings of the repository.
- In docs/troubleshooting.md: messages quoted in headings, which one string of drivesplat/ has to contain; settings to
  copy, which have to be valid; settings named in the text, which have to exist.
"""

import ast
import fnmatch
import io
import re
import sys
import textwrap
import tokenize
from collections.abc import Iterator
from pathlib import Path

import yaml

from drivesplat.errors import ConfigError
from drivesplat.settings.config import Config, load

REPOSITORY = Path(__file__).parents[1]
PYTHON = ("drivesplat", "benchmarks", "examples", "workflow_scripts", "scripts")
TEXTS = (
    "README.md", "Makefile", "config.yaml", "docs/*.md", "report/*.rst", "Snakefile", "rules/*.smk", "scripts/*.sh",
)  # fmt: skip
LINKING = ("README.md", "CHANGELOG.md", "THIRD_PARTY_NOTICES.md", "docs/*.md", "archive/*.md")
FIELDS = ("id", "attr", "name", "arg", "asname")
"""Of a syntax tree's node: where it holds a name."""
SECTIONS = "train|images|masks|lidar_seed|device|datasets|actors|extract"


def forbidden_terms(root: Path) -> Iterator[str]:
    """Names and phrases of tests/forbidden_terms.txt that are used, each with its place."""
    lines = (root / "tests/forbidden_terms.txt").read_text(encoding="utf-8").splitlines()
    name_patterns = [line.removeprefix("name ") for line in lines if line.startswith("name ")]
    phrases = "|".join(re.escape(line.removeprefix("phrase ")) for line in lines if line.startswith("phrase "))
    unknown = [line for line in lines if line and not line.startswith(("#", "name ", "phrase "))]
    yield from (f"tests/forbidden_terms.txt: {line!r} is neither a name nor a phrase" for line in unknown)
    forbidden_name = re.compile("|".join(fnmatch.translate(name) for name in name_patterns))
    forbidden_phrase = re.compile(rf"\b(?:{phrases})\b", re.IGNORECASE)
    texts: list[tuple[Path, str]] = []
    for path in [*root.glob("*.py"), *sorted(path for folder in PYTHON for path in (root / folder).rglob("*.py"))]:
        source, place = path.read_text(encoding="utf-8"), path.relative_to(root)
        tree = ast.parse(source)
        used = names(tree) | set(place.with_suffix("").parts)
        yield from (f"{place}: the name {name}" for name in sorted(used) if forbidden_name.match(name))
        texts += [(place, text) for text in prose(source, tree)]
    for path in (path for pattern in TEXTS for path in sorted(root.glob(pattern))):
        texts.append((path.relative_to(root), path.read_text(encoding="utf-8")))
    for place, text in texts:
        on_one_line = re.sub(r"[\s#*`]+", " ", text)
        for found in forbidden_phrase.finditer(on_one_line):
            yield f"{place}: …{on_one_line[max(0, found.start() - 30) : found.end() + 30]}…"


def names(tree: ast.AST) -> set[str]:
    """Every identifier of a syntax tree: of variables, attributes, functions, classes, arguments and modules."""
    found = (getattr(node, field, None) for node in ast.walk(tree) for field in FIELDS)
    return {part for name in found if isinstance(name, str) for part in name.split(".")}


def prose(source: str, tree: ast.AST) -> Iterator[str]:
    """Comments and strings of a Python file: docstrings, messages, log lines."""
    if "#" in source:
        tokens = tokenize.generate_tokens(io.StringIO(source).readline)
        yield from (token.string for token in tokens if token.type == tokenize.COMMENT)
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def broken_links(root: Path) -> Iterator[str]:
    """Links of the pages to files or headings that do not exist."""
    for page in [page for pattern in LINKING for page in sorted(root.glob(pattern))]:
        for link in sorted(set(re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")))):
            file, _, heading = link.partition("#")
            target = page.parent / file if file else page
            if "://" not in link and not (target.exists() and (not heading or heading in anchors(target))):
                yield f"{page.relative_to(root)}: the link {link} leads nowhere"


def anchors(page: Path) -> set[str]:
    """Those that GitHub makes of the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(encoding="utf-8"), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


def unknown_messages(root: Path) -> Iterator[str]:
    """Messages that headings of docs/troubleshooting.md quote, `…` for what is filled in, without one in the code: no
    string there has their literal parts in this order."""
    trees = (ast.parse(path.read_text(encoding="utf-8")) for path in (root / "drivesplat").rglob("*.py"))
    found = (spelled(node) for tree in trees for node in ast.walk(tree) if isinstance(node, ast.expr))
    strings = [text for text in found if text is not None]
    for heading in re.findall(r"^### (.+)$", (root / "docs/troubleshooting.md").read_text(encoding="utf-8"), re.M):
        for message in re.findall(r"`([^`]+)`", heading):
            parts = [re.escape(part.strip()) for part in message.split("…") if part.strip(" ;:,")]
            pattern = re.compile(".*".join(parts), re.S)
            if ("…" in message or " " in message) and not any(pattern.search(text) for text in strings):
                yield f"docs/troubleshooting.md: no message of the code is `{message}`"


def spelled(node: ast.expr) -> str | None:
    """A string of the source, with … where it is filled in."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return re.sub(r"%[-+0-9.]*[sdrf]", "…", node.value)
    if isinstance(node, ast.JoinedStr):
        return "".join(spelled(part) or "…" for part in node.values)
    return None


def wrong_settings(root: Path) -> Iterator[str]:
    """Settings to copy in docs/troubleshooting.md that are invalid, and names of settings that do not exist."""
    page = (root / "docs/troubleshooting.md").read_text(encoding="utf-8")
    for span, block in re.findall(r"`(\w+: \{[^`]+)`|((?:^    \w+: \{.*\n)+)", page, re.M):
        try:
            load(yaml.safe_load(textwrap.dedent(span or block)))
        except ConfigError as error:
            yield f"docs/troubleshooting.md: {span or block}: {error}"
    schema = Config.model_json_schema()
    for path in sorted(set(re.findall(rf"`((?:{SECTIONS})\.[a-z_.]+)`", page))):
        if not path.endswith((".json", ".npz", ".pkl")) and not known(schema, schema, path.split(".")):
            yield f"docs/troubleshooting.md: there is no setting {path}"


def known(schema: dict, at: dict, keys: list[str]) -> bool:
    """Whether a path of keys exists below `at`, a part of the schema."""
    if not keys:
        return True
    options = [at, *at.get("anyOf", []), *at.get("allOf", [])]
    options += [schema["$defs"][option["$ref"].rpartition("/")[2]] for option in options if "$ref" in option]
    parts = (option["properties"][keys[0]] for option in options if keys[0] in option.get("properties", {}))
    return any(known(schema, part, keys[1:]) for part in parts)


CHECKS = (forbidden_terms, broken_links, unknown_messages, wrong_settings)


def main(root: Path = REPOSITORY) -> int:
    """Prints what is found; 1 if there is anything."""
    found = [problem for check in CHECKS for problem in check(root)]
    print("\n".join(found) if found else "Texts checked.")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
