"""Closed loop: a policy drives in a trained drive. The environment, other traffic, scores, and how far images and scans
can be trusted.

`DriveEnv` and `vector_env` need Gymnasium, an optional package (docs/closed_loop.md); `Simulation` does not.
"""

from importlib import import_module
from typing import Any

_MODULES = {"DriveEnv": "env", "vector_env": "env", "Simulation": "simulation"}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    except ModuleNotFoundError as error:
        if error.name != "gymnasium":
            raise
        raise ImportError(f"{name} needs Gymnasium: pip install 'drivesplat[simulate]', or gymnasium") from None
