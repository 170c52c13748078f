"""Runs as drive folders: the shutters of their images."""

import dataclasses

import pytest
from helpers.hand_made_drive import drive_of
from helpers.hand_made_street import street_model, street_scene

from drivesplat.io.storage import no_provenance
from drivesplat.readers.drive.check import whole_scene
from drivesplat.readers.drive.format import read_drive
from drivesplat.scene.recorded_shutters import shutters
from drivesplat.settings.simulate import RunJob
from drivesplat.simulate.run_folder import write_run_drive


@pytest.mark.parametrize(("rolling", "expected"), [(True, [0.0, 0.02, 0.01]), (False, None)])
def test_a_run_keeps_readout_and_its_middle_of_a_rolling_shutter(tiny_scene, tmp_path, rolling, expected):
    scene = street_scene(tiny_scene)
    camera = dataclasses.replace(scene.cameras[0], readout_s=0.02, readout_direction="down")
    frames = tuple(dataclasses.replace(frame, readout_middle_s=0.01) for frame in scene.frames)
    recorded = dataclasses.replace(scene, cameras=(camera,), frames=frames)
    drive = drive_of(recorded, street_model(), tmp_path / "recorded")
    simulation = {"seconds": 0.3, "start": 1.0, "width": 32, "rolling_shutter": rolling}
    run = {"policy": "recorded", "simulation": simulation}
    job = RunJob.model_validate({"run": run, "edit": None, "code": None, "crf": 18})
    source, path = {"scene": "0001", "method": "street", "run": "slow"}, tmp_path / "run/drive/drive.json"
    write_run_drive(drive, job, path, source, {"episodes": []}, no_provenance())
    again = whole_scene(read_drive(path.parent), path.parent)
    found = [None if one is None else one.readout_s.tolist() for one in shutters(again)]
    assert len(found) > 2 and found == len(found) * [expected]
