"""A drive in an archive: what opening one refuses, and that it writes nowhere else."""

import hashlib
import json
import stat
import zipfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

import drivesplat
from drivesplat.drive.packed_drive import FILES, MANIFEST, SCHEMA, packed_members, packed_scene_id, unpack_drive
from drivesplat.errors import ResultError
from drivesplat.io.aligned_zip import ALIGNMENT, write_aligned_zip

CONTENT = {"one/scene.json": b"{}", "one/mine/checkpoint.npz": bytes(range(256)) * 40, "one/parser.npz": b"p"}


@pytest.fixture
def archive(tmp_path) -> Path:
    """An archive of a method's folder of files, which no reader of drives would take."""
    results = tmp_path / "results"
    for name, content in CONTENT.items():
        (results / name).parent.mkdir(parents=True, exist_ok=True)
        (results / name).write_bytes(content)
    folder = results / "one/mine"
    files = [folder / "checkpoint.npz", results / "one/scene.json", results / "one/parser.npz"]
    path = tmp_path / "packed.usdz"
    write_aligned_zip(path, {"metadata.yaml": b"a: 1\n", **packed_members(folder, "one", files)})
    return path


def rewritten(archive: Path, change, **options) -> Path:
    """Another archive, whose members by name are those that `change` makes of the members."""
    with zipfile.ZipFile(archive) as source:
        members = {name: source.read(name) for name in source.namelist()}
    path = archive.with_name("other.usdz")
    with zipfile.ZipFile(path, "w", **options) as target:
        for name, content in change(members).items():
            target.writestr(zipfile.ZipInfo(name) if not options else name, content)
    return path


def with_manifest(**changes):
    def change(members: dict[str, bytes]) -> dict[str, bytes]:
        return {**members, MANIFEST: json.dumps({**json.loads(members[MANIFEST]), **changes}).encode()}

    return change


def refusal(path: Path, cache: Path) -> str:
    """The sentence with which an archive is refused; nothing may be left."""
    with pytest.raises(ResultError) as refused:
        unpack_drive(path, cache)
    assert not cache.exists() or [*cache.rglob("*")] == []
    text = str(refused.value)
    assert text.startswith(f"{path}: ") and text.count("; ") == 1 and "alpasim" in text
    return text


def test_files_come_out_as_they_went_in_and_once(archive, tmp_path):
    folder = unpack_drive(archive, tmp_path / "cache")
    assert folder.name == "mine" and folder.parent.name == "one"
    for name, content in CONTENT.items():
        assert (folder.parents[1] / name).read_bytes() == content
    before = (folder / "checkpoint.npz").stat()
    assert unpack_drive(archive, tmp_path / "cache") == folder
    assert (folder / "checkpoint.npz").stat() == before
    (folder / "checkpoint.npz").write_bytes(b"cut")
    unpack_drive(archive, tmp_path / "cache")
    assert (folder / "checkpoint.npz").read_bytes() == CONTENT["one/mine/checkpoint.npz"]
    assert len([*(tmp_path / "cache").iterdir()]) == 1


def test_several_may_unpack_at_once(archive, tmp_path):
    with ThreadPoolExecutor(8) as pool:
        folders = {*pool.map(lambda _: unpack_drive(archive, tmp_path / "cache"), range(16))}
    assert len(folders) == 1 and len([*(tmp_path / "cache").iterdir()]) == 1


def test_members_are_aligned_whatever_their_names_and_sizes(tmp_path):
    file = tmp_path / "a file"
    file.write_bytes(b"x" * 1000)
    members = {"a": b"", "some/longer name.bin": b"1" * 63, "ü.txt": "ü".encode(), "z": file}
    write_aligned_zip(tmp_path / "a.zip", members)
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert archive.namelist() == [*members] and archive.testzip() is None
        whole = (tmp_path / "a.zip").read_bytes()
        for member in archive.infolist():
            lengths = whole[member.header_offset + 26 : member.header_offset + 30]
            start = member.header_offset + 30 + sum(int.from_bytes(lengths[i : i + 2], "little") for i in (0, 2))
            assert start % ALIGNMENT == 0 and whole[start : start + member.file_size] == archive.read(member)
    write_aligned_zip(tmp_path / "b.zip", members)
    assert (tmp_path / "b.zip").read_bytes() == whole


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda members: {"metadata.yaml": members["metadata.yaml"]}, f"lacks {MANIFEST}"),
        (lambda members: {**members, MANIFEST: b"{"}, f"damaged {MANIFEST}"),
        (lambda members: {**members, MANIFEST: b"[" * 100_000}, f"damaged {MANIFEST}"),
        (lambda members: {**members, MANIFEST: b"[]"}, f"damaged {MANIFEST}"),
        (with_manifest(schema=SCHEMA - 1), f"version {SCHEMA - 1}, and this drivesplat reads version {SCHEMA}"),
        (with_manifest(schema=SCHEMA + 1), f"version {SCHEMA + 1}"),
        (with_manifest(files={"one/mine/checkpoint.npz": 3}), "list of files is damaged"),
        (with_manifest(files={}), "lists no checkpoint"),
        (with_manifest(folder="../elsewhere"), "leads out of its folder"),
        (with_manifest(files={"one/mine/checkpoint.npz": "", "../../x": ""}), "leads out of its folder"),
        (with_manifest(files={"one/mine/checkpoint.npz": "", "one/more": ""}), f"lacks {FILES}one/more"),
        (lambda members: {n: c for n, c in members.items() if "parser" not in n}, f"lacks {FILES}one/parser.npz"),
        (lambda members: {**members, f"{FILES}one/parser.npz": b"q"}, "damaged member"),
        (lambda members: {**members, "../evil": b""}, "'../evil', whose name leads out"),
        (lambda members: {**members, "/etc/evil": b""}, "'/etc/evil', whose name leads out"),
        (lambda members: {**members, "a\\..\\evil": b""}, "leads out"),
        (lambda members: {**members, "c:evil": b""}, "leads out"),
    ],
)
def test_a_foreign_or_damaged_archive_is_refused_in_a_sentence(archive, tmp_path, change, words):
    assert words in refusal(rewritten(archive, change), tmp_path / "cache")


def test_a_compressed_archive_is_refused(archive, tmp_path):
    path = rewritten(archive, lambda members: members, compression=zipfile.ZIP_DEFLATED)
    assert "compressed member" in refusal(path, tmp_path / "cache")


def test_a_member_that_stands_twice_is_refused(archive, tmp_path):
    with zipfile.ZipFile(archive, "a") as added, pytest.warns(UserWarning, match="Duplicate"):
        added.writestr(MANIFEST, b"{}")
    assert "twice" in refusal(archive, tmp_path / "cache")


def test_a_link_in_an_archive_becomes_no_link(archive, tmp_path):
    target = b"/etc/passwd"
    link = zipfile.ZipInfo(f"{FILES}one/link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(archive) as source:
        members = {name: source.read(name) for name in source.namelist()}
    manifest = json.loads(members[MANIFEST])
    manifest["files"]["one/link"] = hashlib.sha256(target).hexdigest()
    members[MANIFEST] = json.dumps(manifest).encode()
    with zipfile.ZipFile(archive, "w") as changed:
        for name, content in members.items():
            changed.writestr(zipfile.ZipInfo(name), content)
        changed.writestr(link, target)
    file = unpack_drive(archive, tmp_path / "cache").parent / "link"
    assert not file.is_symlink() and file.read_bytes() == target


def test_truncated_archives_and_flipped_bits_are_refused(archive, tmp_path):
    whole = archive.read_bytes()
    for length in (0, 10, len(whole) // 2, len(whole) - 10):
        archive.write_bytes(whole[:length])
        assert "no readable archive" in refusal(archive, tmp_path / "cache")
    with zipfile.ZipFile(archive.with_name("x.usdz"), "w"):
        pass
    at = whole.index(CONTENT["one/mine/checkpoint.npz"]) + 5000
    archive.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    assert "damaged member" in refusal(archive, tmp_path / "cache")


def test_what_is_no_file_is_refused_by_open(tmp_path):
    with pytest.raises(ResultError, match=r"nothing\.usdz: cannot be read"):
        drivesplat.open(tmp_path / "nothing.usdz")
    (tmp_path / "folder.usdz").mkdir()
    with pytest.raises(ResultError, match="a folder, not a regular file"):
        drivesplat.open(tmp_path / "folder.usdz")
    (tmp_path / "text.usdz").write_text("no archive")
    with pytest.raises(ResultError, match="no readable archive"):
        drivesplat.open(tmp_path / "text.usdz")


def test_a_cache_that_cannot_be_written_is_named(archive, tmp_path):
    (tmp_path / "cache").write_text("a file")
    with pytest.raises(ResultError, match=r"cache: cannot be written"):
        unpack_drive(archive, tmp_path / "cache")


BOMB = b"a: &a [x, x]\n" + b"".join(b"%c: &%c [*%c, *%c]\n" % (c, c, c - 1, c - 1) for c in range(98, 110))
"""Lists of lists: m has 2 to the power of 13 entries, and each further line twice as many."""


@pytest.mark.parametrize(
    "metadata",
    [
        BOMB + b"scene_id: *m\n", b"scene_id: " + b"[" * 5000, b"scene_id: [a]\n", b"scene_id:\n", b"a: b\n",
        b"- scene_id\n", b"", b"scene_id: [\n", b"\xff",
    ],
)  # fmt: skip
def test_metadata_without_the_name_of_a_scene_is_damaged(archive, metadata):
    path = rewritten(archive, lambda members: {**members, "metadata.yaml": metadata})
    with pytest.raises(ResultError, match=r"other\.usdz: has a damaged metadata\.yaml \(.*; export it again"):
        packed_scene_id(path)
    named = rewritten(archive, lambda members: {**members, "metadata.yaml": b"scene_id: mine\n"})
    assert packed_scene_id(named) == "mine"
