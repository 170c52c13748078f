"""The street that edits change."""

import pytest
from helpers.hand_made_street import street_model, street_scene

from drivesplat.model.splat_model import SplatModel
from drivesplat.scene.scene import Scene


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


@pytest.fixture(scope="module")
def model() -> SplatModel:
    return street_model()
