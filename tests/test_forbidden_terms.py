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
from helpers.syntax_trees import source_of, tree_of

LINES = (REPOSITORY / "tests/forbidden_terms.txt").read_text(encoding="utf-8").splitlines()
NAMES = [line.removeprefix("name ") for line in LINES if line.startswith("name ")]
PHRASES = [line.removeprefix("phrase ") for line in LINES if line.startswith("phrase ")]
PYTHON = ("drivesplat", "benchmarks", "examples", "workflow_scripts", "scripts")
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
def python_files() -> dict[Path, Path]:
    """The Python files by their paths in the project."""
    paths = [path for folder in PYTHON for path in sorted((REPOSITORY / folder).rglob("*.py"))]
    paths.append(REPOSITORY / "street.py")
    return {path.relative_to(REPOSITORY): path for path in paths if "__pycache__" not in path.parts}


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


@functools.cache
def all_names() -> dict[str, Path]:
    """Every identifier, and a file that has it; the files' own names, too."""
    found = {name: path for path, file in python_files().items() for name in names(tree_of(file))}
    return found | {part: path for path in python_files() for part in path.with_suffix("").parts}


@functools.cache
def all_prose() -> list[tuple[Path, str]]:
    """Every text in which a phrase could stand, on one line, and its file."""
    texts = [(path, text) for path, file in python_files().items() for text in prose(source_of(file), tree_of(file))]
    pages = [path for pattern in TEXTS for path in sorted(REPOSITORY.glob(pattern))]
    texts += [(path.relative_to(REPOSITORY), path.read_text(encoding="utf-8")) for path in pages]
    return [(path, re.sub(r"[\s#*`]+", " ", text)) for path, text in texts]


def containing(phrase: str) -> list[str]:
    """Where a phrase stands, whatever its case and its line breaks, with the words around it."""
    pattern = re.compile(rf"\b{re.escape(phrase)}\b", re.IGNORECASE)
    places = ((path, text, found) for path, text in all_prose() for found in pattern.finditer(text))
    return [f"{path}: {text[max(0, found.start() - 30) : found.end() + 30]}" for path, text, found in places]


@pytest.mark.parametrize("pattern", NAMES)
def test_a_forbidden_name_is_not_used(pattern):
    forbidden = re.compile(fnmatch.translate(pattern))
    assert not {name: str(path) for name, path in all_names().items() if forbidden.match(name)}


@pytest.mark.parametrize("phrase", PHRASES)
def test_a_forbidden_phrase_is_not_used(phrase):
    assert not containing(phrase)


def test_names_and_phrases_are_found():
    source = 'import a.door\ndef f(sheet):\n    """Held\n    to LiDAR."""\n    x.wake = 1  # what  moves\n'
    assert names(ast.parse(source)) >= {"door", "f", "sheet", "wake"}
    assert list(prose(source, ast.parse(source))) == ["# what  moves", "Held\n    to LiDAR."]
    assert len(NAMES) + len(PHRASES) == sum(bool(line) and line[0] != "#" for line in LINES) > 10
