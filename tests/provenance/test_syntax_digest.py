"""Syntax digests are the same under every Python version, and the cache of them is never wrong."""

import ast
import os
from pathlib import Path

import pytest

from drivesplat.provenance.code import code_digest as module
from drivesplat.provenance.code.code_digest import cached_digest, canonical_tree, syntax_digest

CODE = 'import a.b\nfrom . import c\nfrom ..d import e as f\n\nNAME = "g.h"\nWORDS = "i. j"\n'


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "code.py"
    path.write_text(CODE)
    return path


def test_names_are_those_of_imports_and_of_dotted_strings():
    assert syntax_digest(CODE.encode()).names == (".", "..d", "..d.e", ".c", "a.b", "g.h")


WIDTH = "FormattedValue(Name('w', Load()), -1)"
FORMATTED_311 = f"FormattedValue(Name('x', Load()), -1, JoinedStr([Constant('>'), {WIDTH}]))"
FORMATTED_312 = f"FormattedValue(Name('x', Load()), -1, JoinedStr([Constant('>'), {WIDTH}, Constant('')]))"
SPELLINGS = [
    ("f'ab{x:>{w}}'", f"JoinedStr([Constant('ab'), {FORMATTED_311}])"),
    ("f'ab{x:>{w}}'", f"JoinedStr([Constant('ab'), {FORMATTED_312}])"),
    ("f'{x:>{w}}' u'z'", f"JoinedStr([{FORMATTED_311}, Constant('z')])"),
    ("f'{x:>{w}}' u'z'", f"JoinedStr([{FORMATTED_312}, Constant('z', kind='u')])"),
    ("f'a' 'b' f'{w}'", f"JoinedStr([Constant('ab'), {WIDTH}])"),
    ("f'a' 'b' f'{w}'", f"JoinedStr([Constant('a'), Constant('b'), {WIDTH}])"),
    ("f'a' 'b' f'{w}'", f"JoinedStr([JoinedStr([Constant('a')]), Constant('b'), JoinedStr([{WIDTH}])])"),
]
"""F-strings, and their trees as Python 3.11 and 3.12 parse them, or as a version might that splits them elsewhere."""


@pytest.mark.parametrize(("code", "as_dumped"), SPELLINGS)
def test_an_f_string_has_the_same_canonical_tree_in_every_version(code, as_dumped):
    tree = eval(f"Module([Expr({as_dumped})], [])", vars(ast))
    assert canonical_tree(tree) == canonical_tree(ast.parse(code))


def test_the_type_parameters_that_3_12_adds_count_only_where_there_are_some():
    with_field, without = (ast.parse("def f(): return 1\nclass C: x = 1\n") for _ in range(2))
    for node in (*with_field.body, *without.body):
        node._fields = tuple(name for name in node._fields if name != "type_params")
    for node in with_field.body:
        node._fields, node.type_params = (*node._fields, "type_params"), []
    assert canonical_tree(with_field) == canonical_tree(without)
    with_field.body[0].type_params = [ast.Name("T")]
    assert canonical_tree(with_field) != canonical_tree(without)


NESTED_QUOTES = "f\"{table['key']} and {'no' if x else f'{y:.{digits}f}'}\""


def test_nested_quotes_have_one_digest():
    """`ast.unparse` writes these quotes differently under Python 3.11 and 3.12."""
    assert syntax_digest(NESTED_QUOTES.encode()).digest.startswith("78e7e6f73c5de969")


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("x = None", "x = ''"), ("x = 1", "x = 1.0"), ("x = 1", "x = True"), ("x = 'a'", "x = b'a'"),
        ("f(None)", "f()"), ("f'{x}'", "f'{x!r}'"), ("f'{x}{y}'", "f'{x} {y}'"), ("f'{x:>}'", "f'{x:<}'"),
        ("f'{x}'", "'{x}'"), ("def f(*, a=None): ...", "def f(*, a): ..."), ("{None: 1}", "{**1}"),
        ("x: int", "x: int = None"),
        ("if a: b\nelse: c", "if a: b\nc"), ("a < b < c", "(a < b) < c"), ("lambda: x", "lambda x: x"),
        ("async def f(): ...", "def f(): ..."), ("from . import a", "from .. import a"), ("f'{x}' 'a'", "f'{x}' 'b'"),
    ],
)  # fmt: skip
def test_different_code_has_different_digests(one, other):
    assert syntax_digest(one.encode()).digest != syntax_digest(other.encode()).digest


def test_a_file_is_parsed_once_for_all_processes(file, monkeypatch):
    expected = cached_digest(file)
    assert expected == syntax_digest(file.read_bytes())
    monkeypatch.setattr(module, "syntax_digest", None)
    os.utime(file, (1, 1))
    assert cached_digest(file) == expected


def test_changed_content_has_another_digest_even_with_the_same_time_and_size(file):
    before, time = cached_digest(file), file.stat().st_mtime_ns
    file.write_text(CODE.replace("g.h", "g.k"))
    os.utime(file, ns=(time, time))
    assert cached_digest(file) == syntax_digest(file.read_bytes()) != before


def test_a_folder_that_cannot_be_written_goes_without_a_cache(file):
    (file.parent / "__pycache__").write_text("a file")
    assert cached_digest(file) == syntax_digest(file.read_bytes())
