"""Download of nuScenes mini from a local server: complete, resumed, verified, and skipped if the dataset exists."""

import logging
import multiprocessing
import os
import shutil
import signal
import time
import urllib.request
from pathlib import Path

import pytest
from helpers import REPOSITORY, drives
from helpers.archive_server import Site, packed, served
from helpers.drives import World, write_world
from helpers.patience import wait_until

from drivesplat.errors import ConfigError, DatasetError
from drivesplat.readers.nuscenes.download import fetch as fetching
from drivesplat.readers.nuscenes.download import nuscenes_mini
from drivesplat.readers.nuscenes.download.destination import download_job, is_present
from drivesplat.readers.nuscenes.download.fetch import fetch
from drivesplat.readers.nuscenes.download.nuscenes_mini import download, work_folder
from drivesplat.settings.config import load
from drivesplat.workflow.plan import Plan

pytestmark = pytest.mark.usefixtures("uncompared")

CONTENT = bytes(range(256)) * 4000


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    return write_world(tmp_path_factory.mktemp("world"), World(key_frames=3, sweeps_between=0))


@pytest.fixture(scope="module")
def archive(world) -> bytes:
    return packed(world)


@pytest.fixture
def site(archive):
    with served(Site(archive)) as made:
        yield made


@pytest.fixture
def plain():
    """A site whose file is not an archive, for tests that do not unpack it."""
    with served(Site(CONTENT)) as made:
        yield made


@pytest.fixture(autouse=True)
def no_pause(monkeypatch):
    monkeypatch.setattr(fetching, "PAUSE_S", 0.0)
    monkeypatch.setattr(fetching, "MIN_NEW_BYTES", 100_000)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def refused(what: str, *words: str, call) -> str:
    with pytest.raises((DatasetError, ConfigError)) as refusal:
        call()
    message = str(refusal.value)
    assert what in message and all(word in message for word in words) and "\n" not in message, message
    return message


def test_a_valid_archive_becomes_the_dataset_which_is_then_left_unchanged(site, world, tmp_path, capsys):
    root = tmp_path / "data/nuscenes/v1.0-mini"
    download(site.job(root))
    assert files(root) == files(world)
    assert [path.name for path in root.parent.iterdir()] == [root.name]
    assert len(drives.scene_at(root, dataset="nuscenes", sweeps=False).frames) == 3
    (root / "mine.txt").write_text("mine")
    site.asked.clear()
    download(site.job(root))
    assert "already: nothing to do" in capsys.readouterr().err
    assert site.asked == [] and (root / "mine.txt").read_text() == "mine"


def test_other_data_in_the_folder_are_left_unchanged_and_terms_must_be_accepted(site, world, tmp_path):
    foreign, part = tmp_path / "foreign", Path(shutil.copytree(world, tmp_path / "part"))
    foreign.mkdir()
    (foreign / "thesis.tex").write_text("years of work")
    (part / "v1.0-mini/sample.json").unlink()
    for root in (foreign, part):
        before = files(root)
        refused(str(root), "datasets.nuscenes.dataroot", call=lambda root=root: download(site.job(root)))
        assert files(root) == before and site.asked == []
    job = site.job(tmp_path / "mini").model_copy(update={"accept_nuscenes_terms": False})
    refused("accept_nuscenes_terms: true", "https://www.nuscenes.org/terms-of-use", call=lambda: download(job))
    assert site.asked == [] and set(tmp_path.iterdir()) == {foreign, part}


def test_a_kept_archive_is_unpacked_without_network(site, world, tmp_path, caplog):
    """Without a checksum its size alone is checked."""
    job = site.job(tmp_path / "mini", keep_archive=True, sha256=None)
    with caplog.at_level(logging.WARNING):
        download(job)
    assert "only the size of" in caplog.text and is_present(job)
    assert [path.name for path in work_folder(job).iterdir()] == ["v1.0-mini.tgz"]
    shutil.rmtree(tmp_path / "mini")
    site.asked.clear()
    download(job)
    assert site.asked == [] and files(tmp_path / "mini") == files(world)


def test_a_broken_connection_is_resumed(plain, tmp_path):
    plain.cut_after = [300_000, 200_000]
    fetch(plain.settings(attempts=1), tmp_path / "file")
    assert plain.ranges_asked == [None, "bytes=300000-", "bytes=500000-"]
    assert plain.asked[1]["If-Range"] == '"first"'
    assert (tmp_path / "file").read_bytes() == CONTENT and list(tmp_path.iterdir()) == [tmp_path / "file"]


def broken_off(site: Site, path: Path, at: int = 400_000) -> None:
    """A call that is interrupted after `at` bytes."""
    site.cut_after = [at, 0]
    message = refused("kept: run again", f"{at:,} of", call=lambda: fetch(site.settings(attempts=1), path))
    assert site.address in message
    assert fetching.part_of(path).read_bytes() == site.content[:at] and not path.exists()
    site.asked.clear()


@pytest.mark.parametrize("kind", ["no ranges", "another tag", "another address"])
def test_a_download_that_cannot_be_resumed_restarts(plain, tmp_path, kind):
    broken_off(plain, tmp_path / "file")
    settings = plain.settings()
    match kind:
        case "no ranges":
            plain.ranges = False
        case "another tag":
            plain.tag, plain.content = '"second"', CONTENT[::-1]
            settings = plain.settings()
        case "another address":
            settings = plain.settings(url=plain.address + "?key=2")
    fetch(settings, tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == plain.content and len(plain.asked) == 1
    assert ("Range" in plain.asked[0]) == (kind in ("no ranges", "another tag"))


@pytest.mark.parametrize("kind", ["another part", "part of another file", "no such part"])
def test_bytes_outside_the_requested_range_are_not_appended(plain, tmp_path, kind):
    broken_off(plain, tmp_path / "file")
    plain.wrong_range, plain.range_error = kind == "another part", kind == "no such part"
    if kind == "part of another file":
        plain.tag, plain.content, plain.heeds_conditions = '"second"', CONTENT[::-1], False
    fetch(plain.settings(attempts=2), tmp_path / "file")
    assert plain.ranges_asked == ["bytes=400000-", None] and (tmp_path / "file").read_bytes() == plain.content


def in_a_process(call, *arguments) -> multiprocessing.Process:
    process = multiprocessing.get_context("fork").Process(target=call, args=arguments)
    process.start()
    return process


def kill(process: multiprocessing.Process) -> None:
    os.kill(process.pid, signal.SIGKILL)
    process.join()


def test_a_run_killed_while_fetching_is_resumed(site, world, tmp_path):
    job, part = site.job(tmp_path / "mini"), tmp_path / "mini.download/v1.0-mini.tgz.part"
    site.silent_after = len(site.content) // 2
    process = in_a_process(download, job)
    wait_until(lambda: fetching.size_of(part) == site.silent_after)
    kill(process)
    site.silent_after = None
    download(job)
    assert site.ranges_asked == [None, f"bytes={len(site.content) // 2}-"] and files(tmp_path / "mini") == files(world)


def test_a_proxy_in_the_environment_is_used(plain, tmp_path, monkeypatch):
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(urllib.request, "_opener", None)  # it remembers the proxies of its first use
    monkeypatch.setenv("http_proxy", plain.address.removesuffix("/v1.0-mini.tgz"))
    fetch(plain.settings(url="http://nuscenes.invalid/v1.0-mini.tgz"), tmp_path / "file")
    assert (tmp_path / "file").read_bytes() == CONTENT


def slow_download(job) -> None:
    nuscenes_mini.unpack = lambda *_: time.sleep(60)
    download(job)


def test_a_run_killed_while_unpacking_unpacks_again_without_fetching(site, world, tmp_path):
    job = site.job(tmp_path / "mini")
    process = in_a_process(slow_download, job)
    wait_until((work_folder(job) / "v1.0-mini.tgz").is_file)
    refused("another run is downloading", call=lambda: download(job))
    kill(process)
    assert not (tmp_path / "mini").exists()
    (work_folder(job) / "unpacked/v1.0-mini").mkdir(parents=True)
    (work_folder(job) / "unpacked/v1.0-mini/half").write_text("half")
    site.asked.clear()
    download(job)
    assert site.asked == [] and files(tmp_path / "mini") == files(world)


def test_the_first_recorded_dataset_of_the_mini_split_is_the_destination():
    datasets = {
        "made": {"dataroot": "a", "scenes": ["made"], "world": {}},
        "full": {"dataroot": "b", "version": "v1.0-trainval", "scenes": ["0001"]},
        "small": {"dataroot": "~/c", "scenes": ["0061"]},
    }
    assert (download_job(load({"datasets": datasets})).dataset, download_job(load({})).dataset) == ("small", "nuscenes")
    del datasets["small"]
    with pytest.raises(ConfigError, match=r"v1\.0-mini"):
        download_job(load({"datasets": datasets}))


def test_the_download_needs_no_dataset_and_a_missing_scene_names_the_download(tmp_path):
    plan = Plan({"datasets": {"nuscenes": {"dataroot": str(tmp_path / "nowhere")}}}, str(REPOSITORY))
    plan.refuse_absent_data(["download_nuscenes_mini"])
    for targets in (["results/0103/metrics.json"], ["download_nuscenes_mini", "metrics"], []):
        with pytest.raises(DatasetError, match="snakemake --cores 1 download_nuscenes_mini"):
            plan.refuse_absent_data(targets)
    refused("accept_nuscenes_terms", call=lambda: plan.refuse_download(["download_nuscenes_mini"]))
    plan.refuse_download(["metrics"])
