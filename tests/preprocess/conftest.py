"""A drive that a test may damage."""

import shutil
from pathlib import Path

import pytest


@pytest.fixture
def root(tiny_root, tmp_path) -> Path:
    """A copy of the tiny drive."""
    return Path(shutil.copytree(tiny_root, tmp_path / "nuscenes"))
