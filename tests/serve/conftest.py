"""Drives made by hand that the tests of the sensor service share."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.hand_made_street import street_model, street_scene
from helpers.scanned_street import scanned_street
from helpers.served_drives import SensorClient, served, write_mask, write_method

from drivesplat.drive.trained_drive import TrainedDrive


@pytest.fixture(scope="session")
def results(tiny_scene, tmp_path_factory) -> Path:
    """Result folders: of the scene 0001 the methods street and street_lidar, with an ego mask; of the scene 0002, whose
    camera reads its lines downwards in 30 ms, the method street. Read only."""
    folder, scene = tmp_path_factory.mktemp("served") / "results", street_scene(tiny_scene)
    write_method(folder / "0001/street", scene, street_model())
    write_method(folder / "0001/street_lidar", scene, scanned_street(scene), scans=True)
    write_mask(folder / "0001")
    rolling = dataclasses.replace(scene.cameras[0], readout_s=0.03, readout_direction="down")
    write_method(folder / "0002/street", dataclasses.replace(scene, cameras=(rolling,)), street_model())
    return folder


@pytest.fixture(scope="session")
def street(results) -> TrainedDrive:
    """The drive of results/0001/street."""
    import drivesplat

    return drivesplat.open(results / "0001/street", device="cpu")


@pytest.fixture(scope="module")
def client(results) -> Iterator[SensorClient]:
    """A client of a server of all drives."""
    with served(results) as (_, client):
        yield client
