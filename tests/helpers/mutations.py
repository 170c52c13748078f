"""Damage to the files of a dataset, chosen by hypothesis: JSON tables, texts, packed files and files of bytes."""

import functools
import gzip
import inspect
import json
import math
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

CHANCE = st.randoms(use_true_random=False)
"""A generator whose every choice is hypothesis' own, so that it shortens damage that a test finds."""


def damages(few: int, many: int) -> Callable[[Callable], Callable]:
    """Runs a test on `few` choices of its argument `random`, and as a slow test on `many`."""

    def decorate(test: Callable) -> Callable:
        @pytest.mark.parametrize("examples", [few, pytest.param(many, marks=pytest.mark.slow)])
        @functools.wraps(test)
        def run(examples: int, **fixtures: Any) -> None:
            @settings(max_examples=examples)
            @given(random=CHANCE)
            def example(random: Random) -> None:
                test(**fixtures, random=random)

            example()

        own = inspect.signature(test).parameters.values()
        examples = inspect.Parameter("examples", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        run.__signature__ = inspect.Signature([examples, *(one for one in own if one.name != "random")])
        return run

    return decorate


JUNK: list[Any] = [
    None, True, False, 0, 1, -1, 2**31, 2**63, -(2**63) - 1, 10**30, 10**400, 0.5, -0.0, 1e-300, 1e300, math.nan,
    math.inf, -math.inf, "", "False", "0", "1e5", "nowhere", "a" * 5000, "../../x", "/etc/passwd", "\0", "\ud800",
    "line\nbreak", "ä𝄞", [], [[]], [None], [0.0] * 3, [1.0, 0.0, 0.0, 0.0], [1e300] * 3, ["a", "b", "c"],
    [[1.0] * 3] * 3, {}, {"a": 1},
]  # fmt: skip
Rows = list[dict[str, Any]]


@contextmanager
def fresh(parent: Path) -> Iterator[Path]:
    """An empty folder in `parent` for one example, removed afterwards."""
    with TemporaryDirectory(dir=parent) as name:
        yield Path(name)


def likely(random: Random, tenths: int) -> bool:
    """True in so many of ten cases."""
    return random.randrange(10) < tenths


def some_bytes(random: Random, size: int) -> bytes:
    """Arbitrary bytes, of which hypothesis chooses the seed alone."""
    return Random(random.getrandbits(32)).randbytes(size)


def mutate_json(random: Random, content: Any, inwards: int = 8) -> Any:
    """A copy of a JSON object with a value at some place replaced, removed or repeated; `inwards` of ten steps lead on
    to a value within."""
    changed = deepcopy(content)
    holder, key = changed, random.choice(list(changed))
    while isinstance(holder[key], dict | list) and holder[key] and likely(random, inwards):
        holder = holder[key]
        key = random.choice(list(holder)) if isinstance(holder, dict) else random.randrange(len(holder))
    kind = random.randrange(4)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder, list):
        holder.append(deepcopy(holder[key]))
    else:
        holder[key] = deepcopy(random.choice([*JUNK, 3, 2**80, -(2**80), "9" * 5000]))
    return changed


def _leaf(random: Random, row: dict[str, Any]) -> tuple[Any, Any]:
    """A random place within a row: its container and its key or index."""
    container: Any = row
    key: Any = random.choice(list(row)) if row else "token"
    while isinstance(container.get(key) if isinstance(container, dict) else container[key], list):
        inner = container[key]
        if not inner or likely(random, 3):
            break
        container, key = inner, random.randrange(len(inner))
    return container, key


def replace_a_value(random: Random, rows: Rows) -> None:
    """Type confusion, and extreme numbers."""
    container, key = _leaf(random, random.choice(rows))
    container[key] = random.choice(JUNK)


def scale_a_number(random: Random, rows: Rows) -> None:
    """Another unit or sign in one row."""
    row = random.choice(rows)
    numbers = [key for key, value in row.items() if isinstance(value, int | float) and not isinstance(value, bool)]
    if numbers:
        row[random.choice(numbers)] *= random.choice([-1, 1e-6, 1e-3, 1000, 10**6, 0])


def scale_a_column(random: Random, rows: Rows) -> None:
    """Another unit in all rows."""
    key, factor = random.choice(list(rows[0])), random.choice([1e-6, 1000, 10**6, -1])
    for row in rows:
        value = row.get(key)
        if isinstance(value, list):
            row[key] = [it * factor if isinstance(it, float) else it for it in value]
        elif isinstance(value, int | float):
            row[key] = value * factor


def resize_a_list(random: Random, rows: Rows) -> None:
    """A value too many, or too few."""
    row = random.choice(rows)
    lists = [key for key, value in row.items() if isinstance(value, list) and value]
    if lists:
        value = row[random.choice(lists)]
        value.append(value[0]) if likely(random, 5) else value.pop()


def delete_a_column(random: Random, rows: Rows) -> None:
    row = random.choice(rows)
    if row:
        row.pop(random.choice(list(row)))


def delete_a_row(random: Random, rows: Rows) -> None:
    rows.pop(random.randrange(len(rows)))


def repeat_a_row(random: Random, rows: Rows) -> None:
    """With the same token, or with a new one."""
    row = json.loads(json.dumps(random.choice(rows)))
    if likely(random, 5):
        row["token"] = "another"
    rows.insert(random.randrange(len(rows) + 1), row)


def relink(random: Random, rows: Rows) -> None:
    """A link or reference to another row: circles, gaps and records of others."""
    row = random.choice(rows)
    links = [key for key in row if key in ("next", "prev", "sample_token") or key.endswith("_token")]
    if links:
        row[random.choice(links)] = random.choice(rows).get("token", "")


def exchange(random: Random, rows: Rows) -> None:
    """Two rows exchange a value."""
    a, b = random.choice(rows), random.choice(rows)
    key = random.choice(list(rows[0]) or ["token"])
    if key in a and key in b:
        a[key], b[key] = b[key], a[key]


def put_junk_between_rows(random: Random, rows: Rows) -> None:
    rows.insert(random.randrange(len(rows) + 1), random.choice(JUNK))


ROW_MUTATIONS: list[Callable[[Random, Rows], None]] = [
    replace_a_value, replace_a_value, replace_a_value, scale_a_number, scale_a_column, resize_a_list, delete_a_column,
    delete_a_row, repeat_a_row, relink, relink, exchange, put_junk_between_rows,
]  # fmt: skip


def mutate_table(random: Random, path: Path) -> str:
    """Damages a table in place; returns what was done."""
    if random.randrange(7) == 0:
        return f"{path.name}: {mutate_text(random, path)}"
    rows, done = json.loads(path.read_text()), []
    for _ in range(random.choice([1, 1, 2])):
        if rows and all(isinstance(row, dict) and row for row in rows):
            mutation = random.choice(ROW_MUTATIONS)
            mutation(random, rows)
            done.append(mutation.__name__)
    path.write_text(json.dumps(rows))
    return f"{path.name}: {done}"


def mutate_text(random: Random, path: Path) -> str:
    """Truncates, replaces, or deeply nests JSON, or flips its bytes."""
    kind, text = random.choice(["cut", "junk", "deep", "flip"]), path.read_text()
    if kind == "cut":
        path.write_text(text[: random.randrange(len(text))])
    elif kind == "junk":
        path.write_text(json.dumps(random.choice(JUNK)))
    elif kind == "deep":
        deep = "[" * 200_000 + "]" * 200_000
        path.write_text(
            text.replace("[", deep, 1) if likely(random, 5) else text.replace('": ', f'": {deep}, "x": ', 1)
        )
    else:
        flip_bytes(random, path)
    return kind


def flip_bytes(random: Random, path: Path) -> None:
    """Replaces a few bytes."""
    content = bytearray(path.read_bytes())
    for _ in range(random.choice([1, 5, 50])):
        content[random.randrange(len(content))] = random.randrange(256)
    path.write_bytes(content)


def mutate_bytes(random: Random, path: Path) -> str:
    """Truncates a file, fills it with random bytes, or replaces a few of them; returns what was done."""
    kind = random.choice(["cut", "random", "flip", "flip", "empty"])
    size = path.stat().st_size
    if kind == "cut":
        path.write_bytes(path.read_bytes()[: random.randrange(size)])
    elif kind == "random":
        path.write_bytes(some_bytes(random, size))
    elif kind == "flip":
        flip_bytes(random, path)
    else:
        path.write_bytes(b"")
    return f"{path.name}: {kind}"


WORDS = [
    "nan", "inf", "-1", "0", "1e300", "1e30", "99999999999999999999", "x", "", "\0", "ä", "null", "{", "]", "<a>", "'",
]  # fmt: skip


def mutate_words(random: Random, path: Path) -> str:
    """Deletes, repeats or exchanges lines of a text, or replaces, negates or scales numbers; returns what was done."""
    kind, text = random.choice(["delete", "repeat", "exchange", "word", "word", "word", "scale"]), path.read_text()
    lines, numbers = text.splitlines(keepends=True), list(re.finditer(r"-?\d+(\.\d+)?(e[+-]?\d+)?", text))
    if kind in ("word", "scale") and numbers:
        for found in sorted(
            random.sample(numbers, min(len(numbers), random.choice([1, 1, 3]))), key=lambda it: -it.start()
        ):
            scaled = f"{float(found[0]) * random.choice([-1, 1e-3, 1e3, 1e6]):.17g}"
            word = scaled if kind == "scale" else random.choice(WORDS)
            text = text[: found.start()] + word + text[found.end() :]
        path.write_text(text)
    elif lines:
        first, second = random.randrange(len(lines)), random.randrange(len(lines))
        if kind == "delete":
            lines.pop(first)
        elif kind == "repeat":
            lines.insert(first, lines[second])
        else:
            lines[first], lines[second] = lines[second], lines[first]
        path.write_text("".join(lines))
    return f"{path.name}: {kind}"


def mutate_file(random: Random, path: Path) -> str:
    """Damages a file as what it is: a text, a packed file, or bytes; returns what was done."""
    if path.suffix in (".txt", ".json", ".xml") and likely(random, 7):
        return mutate_words(random, path)
    if path.suffix == ".gz" and likely(random, 8):
        path.write_bytes(gzip.decompress(path.read_bytes()))
        done = mutate_bytes(random, path)
        path.write_bytes(gzip.compress(path.read_bytes(), 1))
        return f"unpacked {done}"
    return mutate_bytes(random, path)
