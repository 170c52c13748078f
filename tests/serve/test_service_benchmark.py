"""The benchmark of the sensor service, on a server of this process."""

import os

import pytest
from helpers.served_drives import served

from benchmarks.sensor_service import DISTINCT, FORMATS, RenderClient, RigRequests, RunningServer, soak, speed
from drivesplat.serve.service import SensorService


@pytest.fixture
def server(results):
    """A server of the scene 0002."""
    with served(results / "0002", metrics_port=0) as (running, _):
        yield RunningServer(os.getpid(), running.address, running.metrics_address)


@pytest.fixture
def batches(server, street):
    rig = RigRequests.of(RenderClient(server.address), "0002", street.scene)
    found = [rig.batch(i / 4, (32, 24), FORMATS["jpeg"]) for i in range(4)]
    assert any(item.request.dynamic_objects for batch in found for item in batch.items)
    return found


def test_it_measures_rigs_and_the_share_of_the_model(server, batches):
    text = speed(server, batches, rollouts=2, warm_up=1)
    assert text.startswith("4 rigs, 2 at a time: ") and "rigs/s" in text and "inside of the model" in text


def test_a_wrong_image_ends_a_soak(server, batches, monkeypatch):
    assert "0 wrong images" in soak(server, batches, 10, 2) and DISTINCT > 0
    render, calls = SensorService.render_rgb, []

    def other_at_times(self, request, active):
        calls.append(request)
        if len(calls) > 20:
            request.resolution_w = 16
        return render(self, request, active)

    monkeypatch.setattr(SensorService, "render_rgb", other_at_times)
    with pytest.raises(SystemExit, match=r"1[0-9] wrong images"):
        soak(server, batches, 24, 2)
