"""The gRPC server of the sensor service."""

import importlib
import logging
import socket
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from google.protobuf.message import DecodeError

from drivesplat.errors import RequestError
from drivesplat.machine.device import choose_device
from drivesplat.serve.faults import ServiceError, invalid
from drivesplat.serve.messages import METHODS, SERVICE
from drivesplat.serve.scenes import find_sources
from drivesplat.serve.service import MAX_MESSAGE_BYTES, JpegEncoder, SensorService, ServiceOptions, Unlisted
from drivesplat.settings.device import DeviceSettings

log = logging.getLogger(__name__)

ADDRESS = "127.0.0.1:50051"
"""Where a server listens by default: on this machine alone."""
MAX_CALLS = 64
"""Calls that may need a scene at a time; all but one of them wait for the device."""
SPARE_THREADS = 8
"""Threads for calls that do not wait: those of `PROMPT`, of the health service, and those that are refused."""
PROMPT = ("get_version", "get_available_scenes", "get_loaded_scenes", "get_available_ego_masks")
"""The rpcs that need no scene."""
GRACE_S = 300.0
"""Seconds in which calls may end after a server was told to stop, the deadline of AlpaSim's runtime."""


class SensorServer:
    """A sensor service that listens at an `address`; see docs/simulators.md. `close` ends it.

    >>> server = SensorServer(["results/demo/street"])
    >>> server.address, server.scenes
    ('127.0.0.1:50051', ['demo'])
    >>> server.close()
    """

    def __init__(
        self,
        paths: Sequence[str | Path],
        address: str = ADDRESS,
        *,
        device: str = "any",
        max_loaded: int = 2,
        max_calls: int = MAX_CALLS,
        unlisted: Unlisted = "removed",
        jpeg: JpegEncoder = "threads",
        metrics_port: int | None = None,
        tls: tuple[Path, Path] | None = None,
    ):
        """Starts a server.

        Args:
            paths: Folders of results, of scenes or of methods; `scene.alpasim.usdz`, or a folder of such files.
            address: Host and port; port 0 is any free port.
            device: 'any' (the GPU where there is one), 'cuda' or 'cpu'.
            max_loaded: Number of scenes that may be in memory at a time.
            max_calls: Number of calls that may be in progress at a time, of those that need a scene. Further ones are
                refused at once (RESOURCE_EXHAUSTED).
            unlisted: What a request without dynamic objects shows of those that it could list: 'removed' or 'recorded'.
            jpeg: Where JPEGs are encoded: 'threads' or 'device'.
            metrics_port: Port of this machine's loopback at which figures are served for Prometheus; None: not at all.
            tls: Files of the certificate and of its key (PEM).

        Raises RequestError where gRPC is missing, nothing is to be served, or an address cannot be used, DeviceError
        where the device is missing.
        """
        self._grpc = _required("grpc")
        _required("prometheus_client")
        host, port = _split(address)
        if max_loaded < 1:
            raise RequestError(f"--max-loaded is {max_loaded}; at least one scene must be loaded")
        if max_calls < 1:
            raise RequestError(f"--max-calls is {max_calls}; at least one call must be answered")
        sources = find_sources([Path(path) for path in paths])
        self.device = choose_device(DeviceSettings.model_validate(device), min_free_gb=0.0)
        options = ServiceOptions(_version(), self.device.type, max_loaded, unlisted, jpeg)
        _require_free(host, port)
        self.service = SensorService(sources, options)
        self.scenes = self.service.scene_ids
        self._max_calls, self._places = max_calls, threading.Semaphore(max_calls)
        self._pool = ThreadPoolExecutor(max_calls + SPARE_THREADS, thread_name_prefix="drivesplat-serve")
        self._server = self._grpc.server(
            self._pool,
            options=[
                ("grpc.max_send_message_length", MAX_MESSAGE_BYTES),
                ("grpc.max_receive_message_length", MAX_MESSAGE_BYTES),
                ("grpc.so_reuseport", 0),
            ],
        )
        self._server.add_generic_rpc_handlers([self._handlers()])
        self._health = self._add_health()
        # The address is last: gRPC keeps that of a server which does not start.
        self._page = None if metrics_port is None else _page(self.service, metrics_port)
        try:
            self.address = self._bound(host, port, tls)
        except BaseException:
            self.close(None)
            raise
        self._server.start()

    @property
    def metrics_address(self) -> str | None:
        """Where the figures are, if they are served."""
        return None if self._page is None else f"http://127.0.0.1:{self._page.server_port}/metrics"

    def close(self, grace_s: float | None = GRACE_S) -> None:
        """Refuses new calls, ends when those in progress have been answered, at the latest after `grace_s` seconds."""
        self._health.enter_graceful_shutdown()
        self._server.stop(grace_s).wait()
        self._pool.shutdown()
        self.service.close()
        if self._page is not None:
            self._page.shutdown()
            self._page.server_close()

    def _bound(self, host: str, port: int, tls: tuple[Path, Path] | None) -> str:
        where = f"[{host}]" if ":" in host else host
        try:
            if tls is None:
                bound = self._server.add_insecure_port(f"{where}:{port}")
            else:
                certificate, key = (_read(path) for path in tls)
                bound = self._server.add_secure_port(
                    f"{where}:{port}", self._grpc.ssl_server_credentials([(key, certificate)])
                )
        except RuntimeError:
            bound = 0
        if not bound:
            other = "another --address" if tls is None else "a certificate and its key (PEM), or another --address"
            raise RequestError(f"the sensor service cannot listen at {where}:{port}: choose {other}")
        return f"{where}:{bound}"

    def _handlers(self) -> Any:
        """The rpcs, which get and return bytes: a message that cannot be read is a malformed request, too."""
        handlers = {name: self._grpc.unary_unary_rpc_method_handler(partial(self._call, name)) for name in METHODS}
        return self._grpc.method_handlers_generic_handler(SERVICE, handlers)

    def _call(self, name: str, request: bytes, context: Any) -> bytes:
        """Answers a call. Every error has a status and one sentence."""
        began, code = perf_counter(), "OK"
        try:
            with self._place(name):
                return self._answer(name, request, context.is_active)
        except Exception as error:
            failure = _as_failure(error, name)
            code = failure.code
            context.abort(getattr(self._grpc.StatusCode, code), str(failure))
            raise  # which `abort` does
        finally:
            self.service.figures.called(name, code, perf_counter() - began)

    @contextmanager
    def _place(self, name: str) -> Iterator[None]:
        """A block that answers a call, while others wait: the threads of the pool always suffice for the rpcs of
        `PROMPT`. Raises ServiceError (RESOURCE_EXHAUSTED) where too many calls are in progress."""
        if name in PROMPT:
            yield
            return
        if not self._places.acquire(blocking=False):
            raise ServiceError(
                "RESOURCE_EXHAUSTED",
                f"{name}: {self._max_calls} calls are in progress, and no more may be: wait for their replies, or "
                "start the service with a larger --max-calls",
            )
        try:
            yield
        finally:
            self._places.release()

    def _answer(self, name: str, request: bytes, active: Callable[[], bool]) -> bytes:
        kind, _ = METHODS[name]
        try:
            message = kind.FromString(request)
        except DecodeError:
            raise invalid(f"the request is no {kind.DESCRIPTOR.name}") from None
        reply = getattr(self.service, name)(message, active).SerializeToString()
        if len(reply) > MAX_MESSAGE_BYTES:
            raise ServiceError(
                "RESOURCE_EXHAUSTED",
                f"the reply has {len(reply)} bytes, and a message may have {MAX_MESSAGE_BYTES}: ask for less at a time",
            )
        return reply

    def _add_health(self) -> Any:
        """The standard service by which supervisors ask whether a server is ready."""
        health, pb2_grpc, pb2 = (
            _required(f"grpc_health.v1.{name}") for name in ("health", "health_pb2_grpc", "health_pb2")
        )
        servicer = health.HealthServicer()
        pb2_grpc.add_HealthServicer_to_server(servicer, self._server)
        for service in ("", SERVICE):
            servicer.set(service, pb2.HealthCheckResponse.SERVING)
        return servicer


def _as_failure(error: Exception, name: str) -> ServiceError:
    """Any error as one that a client gets. What is no ServiceError is a bug, and is logged with its traceback."""
    if isinstance(error, ServiceError):
        return error
    if isinstance(error, (torch.cuda.OutOfMemoryError, MemoryError)):
        return ServiceError("RESOURCE_EXHAUSTED", f"{name}: memory is exhausted: ask for smaller images")
    log.exception("%s failed", name)
    return ServiceError("INTERNAL", f"{name} failed with {type(error).__name__}; the log of the server says where")


def _required(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError:
        raise RequestError(
            f"the sensor service needs the package of {module.partition('.')[0]}: pip install 'drivesplat[serve]'"
        ) from None


def _split(address: str) -> tuple[str, int]:
    """Host and port of an address."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65535:
        raise RequestError(f"--address is {address!r}; it is a host and a port, such as {ADDRESS}")
    return host.strip("[]"), int(port)


def _require_free(host: str, port: int) -> None:
    """Raises RequestError where another program listens at a port, before gRPC complains in lines of its own."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except (OSError, UnicodeError) as error:  # UnicodeError: no name of a host
        reason = getattr(error, "strerror", None) or str(error)
        raise RequestError(
            f"the sensor service cannot listen at {host}:{port} ({reason}); choose another --address"
        ) from None


def _page(service: SensorService, port: int) -> Any:
    try:
        return service.figures.serve(port)
    except (OSError, OverflowError) as error:
        raise RequestError(
            f"figures cannot be served at port {port} ({error}); choose another --metrics-port"
        ) from None


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise RequestError(f"{path} cannot be read ({error.strerror})") from None


def _version() -> str:
    try:
        return version("drivesplat")
    except PackageNotFoundError:
        return "of a checkout"
