"""Home-made names and turns of phrase stay out: tests/forbidden_terms.txt lists them."""

import ast
import fnmatch
import functools
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import REPOSITORY

LINES = (REPOSITORY / "tests/forbidden_terms.txt").read_text(encoding="utf-8").splitlines()
NAMES = [line.removeprefix("name ") for line in LINES if line.startswith("name ")]
PHRASES = [line.removeprefix("phrase ") for line in LINES if line.startswith("phrase ")]
PYTHON = ("drivesplat", "benchmarks", "workflow_scripts", "scripts")
TEXTS = (
    "README.md",
    "Makefile",
    "config.yaml",
    "docs/*.md",
    "report/*.rst",
    "Snakefile",
    "rules/*.smk",
    "scripts/*.sh",
)
FIELDS = ("id", "attr", "name", "arg", "asname")
"""Of a syntax tree's node: where it holds a name."""


@functools.cache
def sources() -> dict[Path, str]:
    paths = [path for folder in PYTHON for path in sorted((REPOSITORY / folder).rglob("*.py"))]
    paths = [path for path in paths if "__pycache__" not in path.parts]
    return {path.relative_to(REPOSITORY): path.read_text(encoding="utf-8") for path in paths}


def names(tree: ast.AST) -> set[str]:
    """Every identifier of a syntax tree: of variables, attributes, functions, classes, arguments and modules."""
    found = (getattr(node, field, None) for node in ast.walk(tree) for field in FIELDS)
    return {part for name in found if isinstance(name, str) for part in name.split(".")}


def prose(source: str) -> Iterator[str]:
    """Comments and strings of a Python file: docstrings, messages, log lines."""
    yield from (t.string for t in tokenize.generate_tokens(io.StringIO(source).readline) if t.type == tokenize.COMMENT)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


@functools.cache
def all_names() -> dict[str, Path]:
    """Every identifier, and a file that has it; the files' own names, too."""
    found = {name: path for path, source in sources().items() for name in names(ast.parse(source))}
    return found | {part: path for path in sources() for part in path.with_suffix("").parts}


@functools.cache
def all_prose() -> list[tuple[Path, str]]:
    """Every text in which a phrase could stand, on one line, and its file."""
    texts = [(path, text) for path, source in sources().items() for text in prose(source)]
    pages = [path for pattern in TEXTS for path in sorted(REPOSITORY.glob(pattern))]
    texts += [(path.relative_to(REPOSITORY), path.read_text(encoding="utf-8")) for path in pages]
    return [(path, re.sub(r"[\s#*`]+", " ", text)) for path, text in texts]


def containing(phrase: str) -> list[str]:
    """Where a phrase stands, whatever its case and its line breaks, with the words around it."""
    pattern = re.compile(rf".{{0,30}}\b{re.escape(phrase)}\b.{{0,30}}", re.IGNORECASE)
    return [f"{path}: {found}" for path, text in all_prose() for found in pattern.findall(text)]


@pytest.mark.parametrize("pattern", NAMES)
def test_a_forbidden_name_is_not_used(pattern):
    assert not {name: str(path) for name, path in all_names().items() if fnmatch.fnmatchcase(name, pattern)}


@pytest.mark.parametrize("phrase", PHRASES)
def test_a_forbidden_phrase_is_not_used(phrase):
    assert not containing(phrase)


def test_names_and_phrases_are_found():
    source = 'import a.door\ndef f(sheet):\n    """Held\n    to LiDAR."""\n    x.wake = 1  # what  moves\n'
    assert names(ast.parse(source)) >= {"door", "f", "sheet", "wake"}
    assert list(prose(source)) == ["# what  moves", "Held\n    to LiDAR."]
    assert len(NAMES) + len(PHRASES) == sum(bool(line) and line[0] != "#" for line in LINES) > 10
