"""What a running service counts, in the form of Prometheus."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

SECONDS = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 30.0, 60.0)
"""Bounds of the histogram of latencies."""


class ServiceFigures:
    """Latencies by rpc and status, waiting requests, seconds inside of models, images and their bytes by format, and
    the number of loaded scenes."""

    def __init__(self, loaded: Callable[[], int]):
        """`loaded` tells the number of loaded scenes."""
        from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram

        self.registry = CollectorRegistry()
        own = {"registry": self.registry, "namespace": "drivesplat"}
        self._rpc = Histogram("rpc_seconds", "Latency of calls", ["rpc", "code"], buckets=SECONDS, **own)
        self._waiting = Gauge("waiting_requests", "Calls that wait for the device", **own)
        self._model = Counter("model_seconds", "Seconds in which a model was in use", **own)
        self._images = Counter("images", "Encoded images", ["format"], **own)
        self._bytes = Counter("encoded_bytes", "Bytes of encoded images", ["format"], **own)
        Gauge("loaded_scenes", "Scenes in memory", **own).set_function(loaded)

    def called(self, rpc: str, code: str, seconds: float) -> None:
        """Counts a call that has been answered."""
        self._rpc.labels(rpc, code).observe(seconds)

    def encoded(self, image_format: str, size: int) -> None:
        self._images.labels(image_format).inc()
        self._bytes.labels(image_format).inc(size)

    @contextmanager
    def waiting(self) -> Iterator[None]:
        """A block that waits for the device."""
        with self._waiting.track_inprogress():
            yield

    @contextmanager
    def using_model(self) -> Iterator[None]:
        """A block that uses a model."""
        began = perf_counter()
        try:
            yield
        finally:
            self._model.inc(perf_counter() - began)

    def serve(self, port: int) -> Any:
        """Starts an HTTP server on this machine's loopback, whose page /metrics has the figures; returns it."""
        from prometheus_client import start_http_server

        return start_http_server(port, addr="127.0.0.1", registry=self.registry)[0]
