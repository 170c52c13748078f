"""The inputs that captured iterations with scans share."""

from dataclasses import replace

import numpy as np
import torch
from helpers.trainings import CPU, scan_of_a_wall, settings_of, untrained_street

from drivesplat.model.splat_model import SplatModel
from drivesplat.model.states import SCAN
from drivesplat.scene.scan_record import RecordedScan
from drivesplat.settings.train_scans import ScanTrainingSettings
from drivesplat.training.graphs.inputs import ScanInputs, SharedScanInputs
from drivesplat.training.scans import TrainingScan, load_scans, scan_terms

SETTINGS = settings_of(scans=ScanTrainingSettings(per_image=1.0))


def revolution(x: float, seconds: float) -> RecordedScan:
    """A scan of a wall by a sensor that moves and turns meanwhile; other rays return at each `seconds`."""
    scan = scan_of_a_wall(x, intensity=0.2 + 0.1 * seconds)
    rays = scan.scan.rays
    order = np.random.default_rng(round(10 * seconds)).permutation(30)  # in which its firings fire
    offsets = np.broadcast_to(np.linspace(-0.05, 0.05, 30, dtype=np.float32)[order], rays.offsets_s.shape)
    rays = replace(rays, azimuths=rays.azimuths + np.float32(0.01 * seconds), offsets_s=offsets.copy())
    blocked = scan.blocked.copy()
    blocked[round(5 * seconds)] = True
    returned = scan.scan.returned & (rays.elevations > 0.1 * seconds - 0.1)
    taken = replace(scan.scan, rays=rays, returned=returned)
    moving = {"linear": np.array([3.0, seconds, 0.0]), "angular": np.array([0.0, 0.0, 0.3])}
    return replace(scan, seconds=seconds, scan=taken, blocked=blocked, **moving)


def terms_of(model: SplatModel, scan: TrainingScan, inputs: ScanInputs | None = None) -> dict[str, float]:
    """The loss terms of a scan; with `inputs` by their tensors alone."""
    sets = None if inputs is None else model.sample(inputs.states, SCAN)
    picture = model.scan(scan.view, gaussians=sets, before=scan.range - 0.5)
    return {name: float(value.detach()) for name, value in scan_terms(picture, scan, model, SETTINGS).items()}


def test_scans_of_one_shape_share_their_inputs():
    model, shared = untrained_street(SETTINGS, lidar_logits=(0.0, 2.0)), SharedScanInputs()
    scans = load_scans([revolution(0.0, 0.4), revolution(0.6, 1.2)], SETTINGS.scans, CPU)
    expected = [terms_of(model, scan) for scan in scans]
    assert all(abs(expected[0][name] - expected[1][name]) > 1e-4 for name in ("scan_range", "scan_intensity"))
    places = set()
    for i in (0, 1, 0):
        inputs = shared.load(scans[i], model.states(scans[i].view.time, SCAN))
        assert terms_of(model, inputs.scan, inputs) == expected[i] and inputs.number == 0
        places.add(tuple(values.data_ptr() for values in inputs.tensors))
    assert len(places) == 1, "a graph keeps the addresses"
    assert [terms_of(model, scan) for scan in scans] == expected, "the scans themselves are unchanged"


def test_scans_of_other_shapes_have_inputs_of_their_own():
    """Without intensity, or without rays that the vehicle blocks."""
    model, shared, full = untrained_street(SETTINGS, lidar_logits=(0.0, 2.0)), SharedScanInputs(), revolution(0.0, 0.4)
    silent = replace(full, scan=replace(full.scan, intensities=None))
    scans = load_scans([full, silent, replace(full, blocked=np.zeros_like(full.blocked)), full], SETTINGS.scans, CPU)
    numbers = [shared.load(scan, model.states(scan.view.time, SCAN)).number for scan in scans]
    assert numbers == [0, 1, 2, 0]


def held_by(value: object, path: str = "scan") -> dict[str, torch.Tensor]:
    """All tensors that a scan holds, cached ones too, by their names."""
    if isinstance(value, torch.Tensor):
        return {path: value}
    if isinstance(value, (list, tuple)):
        names = getattr(value, "_fields", range(len(value)))
        items = zip(names, value, strict=True)
    else:
        items = ((name, item) for name, item in getattr(value, "__dict__", {}).items() if item is not value)
    return {k: v for name, item in items for k, v in held_by(item, f"{path}.{name}").items()}


def test_the_tensors_of_a_scan_are_all_that_it_holds():
    """Also what a rendering has cached. One that `tensors` forgot would keep the values of the first scan."""
    (scan,) = load_scans([revolution(0.0, 0.4)], SETTINGS.scans, CPU)
    terms_of(untrained_street(SETTINGS, lidar_logits=(0.0, 2.0)), scan)
    known, held = {values.data_ptr() for values in scan.tensors}, held_by(scan)
    assert len(held) > 30 and any("borders" in name for name in held)
    assert [name for name, values in held.items() if values.data_ptr() not in known] == []
