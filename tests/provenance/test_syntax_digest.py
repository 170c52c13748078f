"""What files say is remembered by their content: never wrong, whatever becomes of what is remembered."""

import os
from pathlib import Path

import pytest

from drivesplat.provenance import syntax_digest as module
from drivesplat.provenance.syntax_digest import Meanings, meaning

CODE = 'import a.b\nfrom . import c\nfrom ..d import e as f\n\nNAME = "g.h"\nWORDS = "i. j"\n'


@pytest.fixture
def file(tmp_path) -> Path:
    path = tmp_path / "code.py"
    path.write_text(CODE)
    return path


def test_names_are_those_of_imports_and_of_dotted_strings():
    assert meaning(CODE.encode()).names == (".", "..d", "..d.e", ".c", "a.b", "g.h")


def test_a_file_is_parsed_once_for_all_processes(file, tmp_path, monkeypatch):
    first = Meanings(tmp_path / "remembered.json")
    expected = first.of(file)
    first.remember()
    monkeypatch.setattr(module, "meaning", None)
    os.utime(file, (1, 1))
    assert Meanings(tmp_path / "remembered.json").of(file) == expected


def test_another_content_has_another_meaning_even_with_the_time_and_size_of_the_first(file, tmp_path):
    known, time = Meanings(tmp_path / "remembered.json"), file.stat().st_mtime_ns
    before = known.of(file)
    file.write_text(CODE.replace("g.h", "g.k"))
    os.utime(file, ns=(time, time))
    assert known.of(file) == meaning(file.read_bytes()) != before


@pytest.mark.parametrize("content", ["", "{", "[]", '{"a": 1}', '{"a": ["b"]}', "null"])
def test_what_is_torn_or_foreign_is_found_anew(file, tmp_path, content):
    path = tmp_path / "remembered.json"
    path.write_text(content)
    known = Meanings(path)
    assert known.of(file) == meaning(file.read_bytes())
    known.remember()
    assert Meanings(path)._known == known._known and len(known._known) == 1


def test_a_folder_that_cannot_be_written_is_done_without(file, tmp_path):
    (tmp_path / "folder").write_text("a file")
    known = Meanings(tmp_path / "folder/remembered.json")
    assert known.of(file) == meaning(file.read_bytes())
    known.remember()


def test_what_is_no_longer_asked_for_is_forgotten_in_the_end(file, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "KEPT", 3)
    path = tmp_path / "remembered.json"
    for number in range(5):
        file.write_text(f"NUMBER = {number}\n")
        known = Meanings(path)
        known.of(file)
        known.remember()
    assert 1 <= len(Meanings(path)._known) <= 3
    assert Meanings(path).of(file) == meaning(file.read_bytes())
