"""The code digest of a stage: comments, docstrings and layout do not change it, every imported module does."""

import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from helpers import REPOSITORY

from drivesplat.provenance.code import code_digest as module

LEAF = '''\
"""What the others import."""

import math

LIMIT = 1000
"""Pixels."""


class Settings:
    """Settings of the leaf."""

    width: int = 640
    """In pixels."""


def area(radius: float, *, scale: float = 1.0) -> float:
    """The area of a disc."""
    # pi r squared
    if radius < 0:
        raise ValueError("a negative radius")
    return math.pi * radius**2 * scale
'''
PACKAGE = {
    "__init__.py": "",
    "leaf.py": LEAF,
    "middle.py": "from toy.leaf import area\n\n\ndef twice(r):\n    return 2 * area(r)\n",
    "far.py": "from toy.middle import twice\n\nRESULT = twice(3)\n",
    "relative.py": "from .leaf import area\n\nRESULT = area(1)\n",
    "sub/__init__.py": "",
    "sub/deep.py": "from ..leaf import area\n\nRESULT = area(1)\n",
    "sub/sibling.py": "from . import deep\n\nRESULT = deep.RESULT\n",
    "opening/__init__.py": "from toy.leaf import area\n",
    "opening/inside.py": "VALUE = 1\n",
    "late.py": "def later(r):\n    from toy.leaf import area\n\n    return area(r)\n",
    "registry.py": 'KINDS = {"leaf": "toy.leaf"}\n\n\ndef load(kind):\n    return __import__(KINDS[kind])\n',
    "circle.py": "import toy.ring\nimport toy.leaf\n",
    "ring.py": "import toy.circle\n",
    "apart.py": "VALUE = 1\n",
}
IMPORTS_LEAF = {
    "directly": "from toy.leaf import area\n\narea(1)\n",
    "as_module": "from toy import leaf\n\nleaf.area(1)\n",
    "renamed": "import toy.leaf as disc\n\ndisc.area(1)\n",
    "everything": "from toy.leaf import *\n",
    "through_another": "from toy.middle import twice\n\ntwice(1)\n",
    "through_two_others": "from toy import far\n",
    "relatively": "import toy.relative\n",
    "relatively_from_below": "import toy.sub.deep\n",
    "relatively_from_beside": "import toy.sub.sibling\n",
    "through_a_package_on_the_way": "import toy.opening.inside\n",
    "inside_a_function": "def run():\n    from toy.leaf import area\n\n    return area(1)\n",
    "inside_an_imported_function": "from toy.late import later\n",
    "if_it_can": "try:\n    import toy.leaf\nexcept ImportError:\n    toy = None\n",
    "by_name": 'from importlib import import_module\n\nimport_module("toy.leaf")\n',
    "by_pattern": 'MODULES = "toy.*.deep"\n',
    "by_name_elsewhere": "from toy.registry import load\n\nload('leaf')\n",
    "in_a_circle": "import toy.ring\n",
}
IMPORTS_NO_LEAF = {
    "nothing": "print(1)\n",
    "another": "from toy.apart import VALUE\n",
    "its_package": "import toy\n",
    "a_sibling_package": "import toy.sub\n",
    "a_pattern_of_others": 'MODULES = "toy.*.absent", "other.*.deep"\n',
    "only_by_word": 'print("leaf", "toy leaf", "toy.leafs")\n',
}


@pytest.fixture
def toy(tmp_path, monkeypatch) -> Path:
    """A package called toy in place of this one, and a script for every way of importing its leaf."""
    for name, text in PACKAGE.items():
        (tmp_path / "toy" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "toy" / name).write_text(text)
    for name, text in {**IMPORTS_LEAF, **IMPORTS_NO_LEAF}.items():
        (tmp_path / f"{name}.py").write_text(text)
    monkeypatch.setattr(module, "PACKAGE", "toy")
    monkeypatch.setattr(module, "PACKAGE_FOLDER", tmp_path / "toy")
    forget()
    yield tmp_path
    forget()


def forget() -> None:
    """As a new process would: it reads every file anew."""
    for cached in (module._syntax, module._content, module._imports, module._file_of, module._modules):
        cached.cache_clear()


def digests(folder: Path) -> dict[str, str]:
    forget()
    return {name: module.code_digest(folder / f"{name}.py") for name in (*IMPORTS_LEAF, *IMPORTS_NO_LEAF)}


def changed_by(folder: Path, file: str, old: str, new: str) -> set[str]:
    """The scripts whose digests an edit changes."""
    before, text = digests(folder), (folder / file).read_text()
    assert text.count(old) == 1
    (folder / file).write_text(text.replace(old, new))
    return {name for name, digest in digests(folder).items() if digest != before[name]}


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("    # pi r squared\n", ""), ("radius**2 * scale\n", "radius**2 * scale  # at the end of a line\n"),
        ('"""What the others import."""\n', ""),
        ('"""What the others import."""', '"""What others import,\n\nat length."""'),
        ('    """The area of a disc."""\n', ""), ('    """Settings of the leaf."""\n', ""),
        ('    """In pixels."""\n', '    """In whole pixels."""\n'), ('    """In pixels."""\n', ""),
        ('"""Pixels."""', '"""Pixels of a region."""'),
        ("LIMIT = 1000\n", "LIMIT = 1_000\n\n\n"), ("LIMIT = 1000", "LIMIT = (1000)"),
        ('"a negative radius"', "'a negative radius'"),
        ("radius: float, *, scale: float = 1.0", "\n    radius: float,\n    *,\n    scale: float = 1.0,\n"),
    ],
)  # fmt: skip
def test_comments_docstrings_and_layout_change_no_digest(toy, old, new):
    assert changed_by(toy, "toy/leaf.py", old, new) == set()


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("LIMIT = 1000", "LIMIT = 1001"), ("LIMIT = 1000", "LIMIT = 1000.0"), ("LIMIT = 1000", "LIMITS = 1000"),
        ("width: int = 640", "width: int = 641"), ("width: int = 640", "width: float = 640"),
        ("scale: float = 1.0", "scale: float = 2.0"), ("*, scale", "scale"), ("radius < 0", "radius <= 0"),
        ("radius**2 * scale", "radius**2 + scale"), ("a negative radius", "radius is negative"),
        ("class Settings:", "class Settings(dict):"), ("def area", "@staticmethod\ndef area"),
        ("import math\n", "import math\nimport os\n"),
    ],
)  # fmt: skip
def test_changed_code_alters_the_scripts_that_import_it_and_no_others(toy, old, new):
    assert changed_by(toy, "toy/leaf.py", old, new) == set(IMPORTS_LEAF)


def test_a_changed_intermediate_module_alters_the_scripts_that_import_through_it(toy):
    through = {"through_another", "through_two_others"}
    assert changed_by(toy, "toy/middle.py", "2 * area", "3 * area") == through


@pytest.mark.parametrize(
    ("file", "counts"),
    [
        ("draw.js", True), ("page.html", True),
        (".DS_Store", False), ("inside.py~", False), ("notes.txt", False), (".#draw.js", False), ("draw.js~", False),
        ("draw.js.orig", False), ("__pycache__/inside.cpython-311.pyc", False), ("deeper/draw.js", False),
    ],
)  # fmt: skip
def test_html_and_javascript_in_a_package_count_and_no_other_file(toy, file, counts):
    """Added, and then changed."""
    path = toy / "toy" / "opening" / file
    path.parent.mkdir(exist_ok=True)
    found = [digests(toy)]
    for content in (b"one", b"two"):
        path.write_bytes(content)
        found.append(digests(toy))
    for before, after in itertools.pairwise(found):
        changed = {name for name in before if before[name] != after[name]}
        assert changed == ({"through_a_package_on_the_way"} if counts else set())


def test_the_script_itself_counts_but_for_its_comments(toy):
    assert len(set(digests(toy).values())) == len(IMPORTS_LEAF) + len(IMPORTS_NO_LEAF)
    assert changed_by(toy, "nothing.py", "print(1)", '"""Prints."""\n\nprint(1)  # one') == set()
    assert changed_by(toy, "nothing.py", "print(1)", "print(2)") == {"nothing"}


def test_touched_files_and_another_folder_change_no_digest(toy, tmp_path, monkeypatch):
    before = digests(toy)
    for path in toy.rglob("*.py"):
        os.utime(path, (1, 1))
    assert digests(toy) == before
    elsewhere = tmp_path / "a checkout elsewhere"
    shutil.copytree(toy / "toy", elsewhere / "toy")
    for script in toy.glob("*.py"):
        shutil.copy(script, elsewhere)
    monkeypatch.setattr(module, "PACKAGE_FOLDER", elsewhere / "toy")
    assert digests(elsewhere) == before


def test_every_stages_digest_is_the_same_in_every_process():
    """Sets and dicts have no order to rely on: hashes of strings differ from process to process."""
    code = (
        "from pathlib import Path; from drivesplat.provenance.code.code_digest import code_digest\n"
        "print([(p.name, code_digest(p)) for p in sorted(Path('workflow_scripts').glob('*.py'))])"
    )
    printed = set()
    for hash_seed in ("1", "2"):
        environment = {**os.environ, "PYTHONHASHSEED": hash_seed}
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=REPOSITORY, env=environment, capture_output=True, text=True, check=True
        )
        printed.add(done.stdout)
    assert len(printed) == 1 and "train.py" in printed.pop()
