"""The benchmark of the sensor service, on a server of this process."""

import dataclasses
import os
import re
from contextlib import contextmanager
from functools import partial

import numpy as np
import pytest
from helpers.served_drives import served

from benchmarks import sensor_service
from benchmarks.sensor_client import FORMATS, RenderClient, RigRequests, RunningServer
from benchmarks.sensor_service import copies, memory, simulate, soak, speed
from drivesplat.serve.faults import invalid
from drivesplat.serve.requests import RequestReader
from drivesplat.serve.scenes import find_sources
from drivesplat.serve.service import SensorService

SMALL = partial(RigRequests.batch, size=(32, 24), image_format=FORMATS["jpeg"])


@pytest.fixture
def server(results):
    """A server of the scene 0002."""
    with served(results / "0002", metrics_port=0) as (running, _):
        yield RunningServer(os.getpid(), running.address, running.metrics_address)


@pytest.fixture
def rig(server, street):
    return RigRequests.of(RenderClient(server.address), "0002", street.scene)


@pytest.fixture
def batches(rig):
    found = [SMALL(rig, i / 4) for i in range(4)]
    assert any(item.request.dynamic_objects for batch in found for item in batch.items)
    return found


def test_it_measures_rigs_and_the_share_of_the_model(server, batches):
    text = speed(server, batches, rollouts=2, warm_up=1)
    assert text.startswith("4 rigs, 2 at a time: ") and "rigs/s" in text and "inside of the model" in text


def test_objects_are_listed_all_by_halves_or_not_at_all(rig):
    counts = [
        len(SMALL(rig, 0.5, listed=listed).items[0].request.dynamic_objects) for listed in ("all", "half", "none")
    ]
    assert counts[0] >= 2 and counts == [counts[0], (counts[0] + 1) // 2, 0]


def test_rollouts_with_and_without_objects_interleave(server, rig, monkeypatch):
    text = simulate(server, [rig], SMALL, frames=12, rollouts=3)
    assert text.startswith("12 frames of 3 images in 3 rollouts: ") and "; 0 black images; " in text
    assert re.search(r"[34] of 4 frames change with none of the objects", text), text
    assert "0 of 3 frames differ when they are asked for alone" in text
    render, calls = SensorService.batch_render_rgb, []

    def other_later(self, request, active):
        calls.append(request)
        if len(calls) > 12:
            request.items[0].request.resolution_w = 16
        return render(self, request, active)

    monkeypatch.setattr(SensorService, "batch_render_rgb", other_later)
    with pytest.raises(SystemExit, match="3 of 3 frames differ"):
        simulate(server, [rig], SMALL, frames=12, rollouts=3)


def test_a_missing_image_and_a_missing_scene_end_rollouts(server, rig, monkeypatch):
    with pytest.raises(SystemExit, match="0003 is not served"):
        simulate(server, [dataclasses.replace(rig, scene_id="0003")], SMALL, frames=2, rollouts=1)
    monkeypatch.setattr(RequestReader, "image", lambda *_: (_ for _ in ()).throw(invalid("no camera")))
    with pytest.raises(SystemExit, match="INVALID_ARGUMENT: no camera"):
        simulate(server, [rig], SMALL, frames=2, rollouts=1)


def test_a_drive_under_many_names_has_a_folder_of_links_for_each(results, tmp_path):
    (source,) = find_sources([results / "0002/street"]).values()
    methods = copies(source, tmp_path, 3)
    assert [*find_sources(methods)] == ["0002_0", "0002_1", "0002_2"]
    assert all(file.is_symlink() for file in tmp_path.rglob("*") if not file.is_dir())


def test_memory_is_that_of_a_server_that_offers_more_than_it_loads(results, tmp_path, monkeypatch):
    loaded = []

    @contextmanager
    def in_this_process(paths, device, options):
        with served(*paths, max_loaded=int(options[1]), metrics_port=0) as (running, _):
            yield RunningServer(os.getpid(), running.address, running.metrics_address)
            loaded.append(len(running.service._drives))

    monkeypatch.setattr(sensor_service, "running_server", in_this_process)
    (source,) = find_sources([results / "0002/street"]).values()
    text = memory(copies(source, tmp_path, 3), "cpu", SMALL, frames=2)
    assert text.startswith("3 scenes offered: ") and "after 2 rigs of 2 scenes" in text and loaded == [2]


def test_a_wrong_image_ends_a_soak(server, batches, monkeypatch, tmp_path):
    assert "0 wrong images" in soak(server, batches, 10, 2, tmp_path / "soak.csv")
    table = np.genfromtxt(tmp_path / "soak.csv", delimiter=",", names=True)
    assert table.dtype.names == ("seconds", "memory_mb", "open_files") and len(table) >= 2
    assert (table["memory_mb"] > 50.0).all() and (table["open_files"] > 3).all()
    render, calls = SensorService.render_rgb, []

    def other_at_times(self, request, active):
        calls.append(request)
        if len(calls) > 20:
            request.resolution_w = 16
        return render(self, request, active)

    monkeypatch.setattr(SensorService, "render_rgb", other_at_times)
    with pytest.raises(SystemExit, match=r"1[0-9] wrong images"):
        soak(server, batches, 24, 2)
