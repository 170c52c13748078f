"""Bad servers, bad archives, no room: one line, nothing written outside, and nothing bad kept."""

import gzip
import io
import resource
import shutil
import socket
import stat
import tarfile
from collections import namedtuple
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers.archive_server import Site, packed, served
from helpers.drives import World, write_world
from helpers.killed_runs import only_complaint
from helpers.workflow_copy import WorkflowCopy

from drivesplat.errors import DatasetError
from drivesplat.readers.nuscenes.download import fetch as fetching
from drivesplat.readers.nuscenes.download.nuscenes_mini import download, work_folder
from drivesplat.settings.download import DownloadJob

ACCEPTED = ("--config", "accept_nuscenes_terms=True")
Usage = namedtuple("Usage", "total used free")


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> bytes:
    return packed(write_world(tmp_path_factory.mktemp("world"), World(key_frames=3, sweeps_between=0)))


@pytest.fixture(autouse=True)
def no_pause(monkeypatch):
    monkeypatch.setattr(fetching, "PAUSE_S", 0.0)


def refused(job: DownloadJob) -> str:
    """The line that a download ends with, after checks that hold for all of them: nothing lies outside the folder of
    the download, and nothing was unpacked."""
    outside = Path(job.dataroot).parent
    before = sorted(outside.rglob("*"))
    with pytest.raises(DatasetError) as refusal:
        download(job)
    message, folder = str(refusal.value), work_folder(job)
    assert "\n" not in message
    assert [path for path in sorted(outside.rglob("*")) if not path.is_relative_to(folder)] == before
    assert not (folder / "v1.0-mini.tgz").exists() and not (folder / "unpacked").exists()
    return message


def nothing_kept(job: DownloadJob) -> bool:
    return [path.name for path in work_folder(job).iterdir()] == ["lock"]


@pytest.mark.parametrize(
    ("site", "changed", "words"),
    [
        ({}, {"sha256": "0" * 64}, ["SHA-256", "has been removed"]),
        ({}, {"size_bytes": 10}, ["bytes, nuscenes_mini.size_bytes says 10;"]),
        ({}, {"size_bytes": 10**6}, ["nuscenes_mini.size_bytes says 1,000,000"]),
        ({"length": -1}, {"size_bytes": 10}, ["has more than 10 bytes"]),
        ({"status": 404}, {}, ["HTTP 404 Not Found"]),
        ({"status": 403}, {}, ["HTTP 403"]),
    ],
)
def test_a_wrong_answer_is_a_line_and_nothing_is_kept(archive, tmp_path, site, changed, words):
    with served(Site(archive, **site)) as made:
        job = made.job(tmp_path / "mini", **changed)
        message = refused(job)
    assert made.address in message and all(word in message for word in words), message
    assert nothing_kept(job) and len(made.asked) == 1


def test_a_server_in_trouble_is_asked_again_so_often_and_no_more(archive, tmp_path):
    with served(Site(archive, status=503)) as site:
        assert "HTTP 503" in refused(site.job(tmp_path / "mini", attempts=2))
    assert len(site.asked) == 2


@pytest.mark.parametrize("length", [None, -1])
def test_a_file_that_ends_early_is_kept_for_the_next_run(archive, tmp_path, length):
    with served(Site(archive, length=length, cut_after=[1000, 0, 0])) as site:
        job = site.job(tmp_path / "mini", attempts=2)
        assert f"1,000 of {len(archive):,} bytes are kept: run again" in refused(job)
        site.length = None
        download(job)
    assert site.ranges_asked == [None, "bytes=1000-", "bytes=1000-", "bytes=1000-"]
    assert (tmp_path / "mini/v1.0-mini/scene.json").is_file()


@pytest.mark.parametrize(
    ("headers", "words"),
    [
        (False, ["slower than nuscenes_mini.min_kb_per_s, 5 kB/s", "are kept: run again"]),
        (True, ["no complete answer within 0.5 s"]),
    ],
)
def test_a_server_that_trickles_is_left(archive, tmp_path, headers, words):
    """A byte at a time never is silence; what has come is kept."""
    with served(Site(archive, trickle_s=0.05, headers_trickle=headers)) as site:
        message = refused(site.job(tmp_path / "mini", attempts=1, timeout_s=0.5))
        assert all(word in message for word in words), message
        site.trickle_s, site.headers_trickle = None, False
        download(site.job(tmp_path / "mini"))
    assert (tmp_path / "mini/v1.0-mini/scene.json").is_file()


def test_no_server_is_a_line(tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        site = Site(b"", address=f"http://127.0.0.1:{probe.getsockname()[1]}/v1.0-mini.tgz")
    assert "Connection refused" in refused(site.job(tmp_path / "mini", size_bytes=10))


def test_a_full_disk_is_reported_before_anything_is_fetched(archive, tmp_path, monkeypatch):
    asked = []

    def usage(path: Path) -> Usage:
        asked.append(path)
        return Usage(10**10, 0, int(1e8) + len(archive) - 1)

    monkeypatch.setattr(shutil, "disk_usage", usage)
    with served(Site(archive)) as site:
        (tmp_path / "disk").mkdir()
        message = refused(site.job(tmp_path / "disk/mini"))
        assert "make room" in message and str(tmp_path) in message
        assert asked == [tmp_path / "disk/mini.download"] and site.asked == []
        monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(10**10, 0, int(1e8) + len(archive)))
        download(site.job(tmp_path / "disk/mini"))


def test_a_disk_that_fills_up_is_a_line_and_keeps_what_has_come(archive, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with served(Site(archive)) as site:
        resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))
        try:
            message = refused(site.job(tmp_path / "mini"))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert "v1.0-mini.tgz.part: cannot be written (File too large)" in message
        monkeypatch.setattr(tarfile.TarFile, "makefile", full)
        with pytest.raises(DatasetError, match="No space left on device"):
            download(site.job(tmp_path / "mini"))
        monkeypatch.undo()
        download(site.job(tmp_path / "mini"))
    assert site.ranges_asked == [None, "bytes=5000-"] and (tmp_path / "mini/v1.0-mini/scene.json").is_file()


Member = Callable[[tarfile.TarFile, Path], None]


def member(name: str, kind: bytes = tarfile.REGTYPE, link: str = "", size: int = 0) -> Member:
    """Adds one member of zeros."""

    def add(tar: tarfile.TarFile, _: Path) -> None:
        info = tarfile.TarInfo(name)
        info.type, info.linkname, info.size, info.mode = kind, link, size, 0o7777
        tar.addfile(info, io.BytesIO(bytes(size)) if size else None)

    return add


def members(*added: Member) -> Member:
    """Adds one after another."""

    def add(tar: tarfile.TarFile, outside: Path) -> None:
        for one in added:
            one(tar, outside)

    return add


def absolute(tar: tarfile.TarFile, outside: Path) -> None:
    member(f"{outside}/evil")(tar, outside)


def through_a_link(tar: tarfile.TarFile, outside: Path) -> None:
    members(member("samples/out", tarfile.SYMTYPE, str(outside)), member("samples/out/evil"))(tar, outside)


def with_headers(name: str, **headers: str) -> Member:
    """Adds an empty file with these headers of the PAX format."""

    def add(tar: tarfile.TarFile, _: Path) -> None:
        info = tarfile.TarInfo(name)
        info.pax_headers = headers
        tar.addfile(info)

    return add


def declared(name: str, kind: bytes, size: int) -> Member:
    """Adds a header that announces more than follows."""

    def add(tar: tarfile.TarFile, _: Path) -> None:
        info = tarfile.TarInfo(name)
        info.type, info.size = kind, size
        tar.fileobj.write(info.tobuf(tarfile.GNU_FORMAT))

    return add


def raw(content: bytes) -> Member:
    """Adds bytes as they are."""
    return lambda tar, _: tar.fileobj.write(content)


BELOW_A_FILE = [member("samples/evil"), member("samples/evil/file")]
SPARSE = {"GNU.sparse.map": "0,1", "GNU.sparse.size": str(10**12)}


def repacked(archive: bytes, add: Member, outside: Path) -> bytes:
    """The good archive with something bad at its end."""
    content = io.BytesIO()
    with (
        tarfile.open(fileobj=io.BytesIO(archive)) as good,
        gzip.GzipFile(fileobj=content, mode="wb", compresslevel=1) as stream,
        tarfile.open(fileobj=stream, mode="w", format=tarfile.PAX_FORMAT) as tar,
    ):
        for info in good:
            tar.addfile(info, good.extractfile(info) if info.isfile() else None)
        add(tar, outside)
    return content.getvalue()


UNTRUSTED = [
    ("is no safe path", [
        member("../evil"), member("samples/../../evil"), absolute, member("\\\\host\\evil"), member("samples\\evil"),
        member("samples/\x1b[2Jevil\n"),
    ]),
    ("neither a file nor a folder", [
        through_a_link, member("samples/in", tarfile.SYMTYPE, "maps"), member("evil", tarfile.LNKTYPE, "/etc/passwd"),
        member("evil", tarfile.CHRTYPE), member("evil", tarfile.FIFOTYPE), with_headers("samples/sparse", **SPARSE),
    ]),
    ("is in it twice", [member("v1.0-mini/scene.json")]),
    ("is both a file and a folder", [members(*BELOW_A_FILE), members(*reversed(BELOW_A_FILE))]),
    ("has a path of absurd length", [member("d/" * 2500 + "evil"), member("d" * 2000 + "/evil")]),
    ("impossible size or time", [
        with_headers("evil", size="-5"), with_headers("evil", mtime="nan"), with_headers("evil", mtime="1e300"),
    ]),
    ("more than 0.1 GB", [declared("evil", tarfile.REGTYPE, 10**12), member("evil", size=100_000_000)]),
    ("absurd size", [
        declared("evil", tarfile.XHDTYPE, 10**10), declared("evil", tarfile.GNUTYPE_LONGNAME, 10**10)
    ]),
    ("more than 200 files", [
        members(*(member(f"samples/{number}") for number in range(300))),
        members(*[member("samples", tarfile.DIRTYPE)] * 300),
    ]),
    ("is damaged (a broken header)", [raw(b"\xff" * 2048)]),
    ("is damaged (there is no end to it)", [raw(bytes(3 << 20))]),
]  # fmt: skip


@pytest.mark.parametrize(("why", "add"), [(why, add) for why, added in UNTRUSTED for add in added])
def test_an_archive_that_is_not_to_be_trusted_is_refused_before_anything_is_written(archive, tmp_path, add, why):
    """Even where its checksum is right."""
    with served(Site(repacked(archive, add, tmp_path))) as site:
        job = site.job(tmp_path / "data/mini", max_files=200)
        message = refused(job)
    assert why in message and "has been removed" in message, message
    assert nothing_kept(job)
    assert not any(path.name.endswith("evil") for path in tmp_path.rglob("*"))


def damaged(archive: bytes, kind: str) -> bytes:
    place, content = len(archive) // 2, io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as tar:
        member("v1.0-mini/scene.json", size=10)(tar, Path())
    return {
        "a web page": b"<html>log in first</html>",
        "empty": gzip.compress(b""),
        "truncated": archive[:place],
        "end missing": archive[:-4],
        "a flipped bit": archive[:place] + bytes([archive[place] ^ 1]) + archive[place + 1 :],
        "other data": content.getvalue(),
    }[kind]


@pytest.mark.parametrize("kind", ["a web page", "empty", "truncated", "end missing", "a flipped bit", "other data"])
def test_an_archive_that_is_damaged_or_another_is_refused_where_no_checksum_tells(archive, tmp_path, kind):
    with served(Site(damaged(archive, kind))) as site:
        job = site.job(tmp_path / "mini", sha256=None)
        message = refused(job)
    assert ("it is no such dataset" if kind == "other data" else "is damaged (") in message, message
    assert nothing_kept(job)


def test_no_file_of_an_archive_may_run_as_another_user(archive, tmp_path):
    with served(Site(repacked(archive, member("samples/tool"), tmp_path))) as site:
        download(site.job(tmp_path / "mini"))
    assert not (tmp_path / "mini/samples/tool").stat().st_mode & (stat.S_ISUID | stat.S_ISGID | stat.S_IWOTH)


@pytest.mark.slow
@pytest.mark.workflow
@pytest.mark.xdist_group("download")
def test_through_the_workflow_it_is_refused_then_fetched_then_read(archive, tmp_path):
    copy = WorkflowCopy.make(tmp_path / "workflow", World(key_frames=3, sweeps_between=0), methods={"vanilla": {}})
    shutil.rmtree(copy.folder / "data")
    line = only_complaint(copy.run("download_nuscenes_mini"))
    assert "accept_nuscenes_terms: true" in line and "nuscenes.org/terms-of-use" in line
    assert not (copy.folder / "results").exists()
    with served(Site(archive)) as site:
        settings = site.settings()
        copy.config |= {"nuscenes_mini": settings.model_dump()}
        copy.write_config()
        done = copy.run("download_nuscenes_mini", flags=ACCEPTED)
        assert done.returncode == 0 and "nuScenes v1.0-mini is in " in done.stdout, done.stdout
        assert len(site.asked) == 1
        done = copy.run("results/0001/scene.json")
        assert done.returncode == 0 and "download_nuscenes_mini" not in done.stdout, done.stdout
        shutil.rmtree(copy.folder / "data")
        assert copy.run("download_nuscenes_mini", flags=ACCEPTED).returncode == 0 and len(site.asked) == 2
    assert (copy.folder / "data/v1.0-mini/scene.json").is_file()
    assert "download_nuscenes_mini" not in copy.planned()
