"""The command `drivesplat serve`, without a server."""

import signal
import threading
from types import SimpleNamespace

import pytest

import drivesplat
from drivesplat.cli.__main__ import main

PATIENCE_S = 30.0


@pytest.fixture
def restored():
    """Signals are handled as before after the test."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield
    for number, handler in handlers.items():
        signal.signal(number, handler)


def test_a_signal_ends_it_whichever_thread_it_reaches(restored, monkeypatch, capsys):
    closed, waited_in_vain = threading.Event(), threading.Event()
    waiting = threading.get_ident()

    def wake():
        waited_in_vain.set()
        signal.pthread_kill(waiting, signal.SIGTERM)

    patience = threading.Timer(PATIENCE_S, wake)

    def started(*arguments, **options):
        threading.Timer(0.1, lambda: signal.pthread_kill(threading.get_ident(), signal.SIGTERM)).start()
        patience.start()
        return SimpleNamespace(
            device=SimpleNamespace(type="cuda"), metrics_address=None, address="x:1", scenes=["demo"], close=closed.set
        )

    monkeypatch.setattr(drivesplat, "SensorServer", started)
    assert main(["serve", "results/demo/street"]) == 0
    patience.cancel()
    assert closed.is_set() and not waited_in_vain.is_set()
    assert "ending" in capsys.readouterr().out
