"""What a request can be refused for: a status code of gRPC and one sentence."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from drivesplat.errors import DeviceError, DriveSplatError, RequestError

StatusName = Literal[
    "CANCELLED",
    "INVALID_ARGUMENT",
    "NOT_FOUND",
    "OUT_OF_RANGE",
    "FAILED_PRECONDITION",
    "RESOURCE_EXHAUSTED",
    "INTERNAL",
]
"""Names in `grpc.StatusCode`."""


class ServiceError(DriveSplatError):
    """A request that is answered with an error. `code` is its status."""

    def __init__(self, code: StatusName, message: str):
        super().__init__(message)
        self.code: StatusName = code


def invalid(message: str) -> ServiceError:
    """The error of a malformed request."""
    return ServiceError("INVALID_ARGUMENT", message)


@contextmanager
def as_service_errors() -> Iterator[None]:
    """Gives errors of the library the status that a client expects: what a request asks for in vain is
    INVALID_ARGUMENT, exhausted memory RESOURCE_EXHAUSTED, and an unusable result FAILED_PRECONDITION."""
    try:
        yield
    except ServiceError:
        raise
    except RequestError as error:
        raise invalid(str(error)) from error
    except DeviceError as error:
        raise ServiceError("RESOURCE_EXHAUSTED", str(error)) from error
    except DriveSplatError as error:
        raise ServiceError("FAILED_PRECONDITION", str(error)) from error
