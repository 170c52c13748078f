"""An edited drive against its truth: here the truth is what the model itself shows after the edit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers.hand_made import recording_of
from helpers.hand_made_street import TURNING, checkpoint_of, street_model, street_scene
from helpers.hand_made_truth import depth_values, write_array

from drivesplat.editing.actors import edited_model
from drivesplat.editing.assets.asset import Asset, Inserts
from drivesplat.editing.assets.stage import assets_of
from drivesplat.editing.placed_model import placed_models
from drivesplat.errors import DatasetError
from drivesplat.evaluation.synthetic import DriveTruth
from drivesplat.io.storage import no_provenance
from drivesplat.model.view import view_of
from drivesplat.readers.nuscenes.tokens import token
from drivesplat.readers.truth import TRUTH_FILE, Truth, TruthFrame, TruthView, write_truth_file
from drivesplat.scene.evaluation_data import EvaluationData
from drivesplat.scene.light import SceneLight
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.edit import Edit
from drivesplat.settings.images import HoldoutSettings
from drivesplat.settings.render import EditJob
from drivesplat.visuals.edit_truth import measure_edit

CPU = DeviceSettings(kind="cpu")
NAME = "elsewhere/street/car"
EDIT = Edit.model_validate(
    {"steps": [{"insert": {"asset": NAME, "as": "it", "at": [14.0, 1.0], "match_exposure": False, "yaw": 180}}]}
)
JOB = EditJob(
    fps=4, crf=20, captions=False, camera="CAM_FRONT", width=None, height=None, horizontal_fov=None, edit=EDIT
)


@pytest.fixture(scope="module")
def recording(tiny_scene, tmp_path_factory) -> EvaluationData:
    """Images that the model itself shows before the edit."""
    made, frames, model = recording_of(street_scene(tiny_scene), width=64), [], street_model()
    for index, frame in enumerate(made.scene.frames):
        view = view_of(made.record, index, torch.device("cpu"))
        path = tmp_path_factory.getbasetemp() / "recorded" / frame.camera / f"{frame.timestamp}.png"
        with torch.no_grad():
            write_array(path, bytes_of(model.render(view).image))
        frames.append(replace(frame, image_path=str(path)))
    return replace(made, scene=replace(made.scene, frames=tuple(frames)))


def bytes_of(image: torch.Tensor) -> np.ndarray:
    return (image.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


@pytest.fixture(scope="module")
def inserts(recording) -> Inserts:
    (asset,) = (
        found
        for found in assets_of(street_model(), recording.scene, HoldoutSettings(), "street", {}, no_provenance())
        if found.source["track"] == TURNING
    )
    whole: Asset = replace(asset, seen=np.array([np.pi]))
    return Inserts({NAME: whole}, SceneLight(0.3))


@pytest.fixture(scope="module")
def known(recording, inserts, tmp_path_factory) -> DriveTruth:
    root, scene = tmp_path_factory.mktemp("truth"), recording.scene
    edited = edited_model(street_model(), scene, "CAM_FRONT", EDIT, "a test", inserts)
    frames = [i for i, f in enumerate(scene.frames) if f.is_key_frame and f.camera == "CAM_FRONT"]
    after = [_frame(root, recording, edited, index) for index in frames]
    recorded = [replace(frame, image=None) for frame in after]
    views = (
        TruthView("CAM_FRONT", 0.0, None, None, tuple(recorded)),
        TruthView("CAM_FRONT", 0.0, "it", None, tuple(after)),
    )
    truth = Truth(
        scene=scene.name, width=64, height=36, samples_per_pixel=1, leading=None,
        instances={"7": token(scene.name, "instance", "it")}, classes={"0": "sky"}, views=views, pattern=None, scans=(),
    )  # fmt: skip
    write_truth_file(root, truth)
    return DriveTruth.read(root / TRUTH_FILE, recording)


@torch.no_grad()
def _frame(root: Path, recording: EvaluationData, edited, index: int) -> TruthFrame:
    frame, view = recording.frame(index), view_of(recording.record, index, torch.device("cpu"))
    at = np.array([view.time])
    (placed,) = placed_models(edited.model, edited.actors, at)
    number = [actor.id for actor in edited.actors if actor.present(at)[0]].index("it")
    names = [f"{kind}/{index}.png" for kind in ("image", "depth", "instances", "classes")]
    found = placed.objects_in(view).numpy() == number
    image = bytes_of(placed.render(view).image)
    depth = depth_values(placed.surface_depth(view).numpy())
    for name, values in zip(names, (image, depth, (7 * found).astype(np.uint8), np.zeros_like(depth)), strict=True):
        write_array(root / "truth" / name, values)
    image_name, depth_name, instances, classes = names
    return TruthFrame(
        frame.token, frame.sample_index, frame.camera_to_world.tolist(), image_name, depth_name, instances, classes
    )


def test_what_is_rendered_as_it_truly_is_has_no_error_but_that_of_eight_bits(known, inserts):
    record, picture = measure_edit(checkpoint_of(street_model()), known, JOB, "it", inserts, CPU)
    inserted, without = record["inserted"], record["not_inserted"]
    assert record["frames"] == 10 and record["mask_iou"] == 1.0
    assert inserted["object"]["psnr"] > 50.0 > 25.0 > without["object"]["psnr"]
    assert inserted["depth"]["median_relative_error"] < 2e-3
    assert inserted["outside"]["psnr"] > 50.0 and record["changed_elsewhere"] < 0.2
    assert picture.dtype == np.uint8 and picture.shape[1] == 3 * known.recording.size(0)[0]


def test_figures_are_apart_by_the_angle_to_the_nearest_seen_direction(known, inserts):
    """The camera sees the front of an object that is turned to it: seen from behind alone, that is 180 degrees away."""
    record, _ = measure_edit(checkpoint_of(street_model()), known, JOB, "it", inserts, CPU)
    pixels = {angle: found["pixels"] if found else 0 for angle, found in record["by_angle_deg"].items()}
    assert pixels["90-180"] > 0 and pixels["0-30"] == pixels["30-90"] == 0
    from_the_front = Inserts({NAME: replace(inserts.assets[NAME], seen=np.array([0.0]))}, inserts.light)
    record, _ = measure_edit(checkpoint_of(street_model()), known, JOB, "it", from_the_front, CPU)
    nearer = {angle: found["pixels"] if found else 0 for angle, found in record["by_angle_deg"].items()}
    assert nearer["0-30"] > nearer["30-90"] and sum(nearer.values()) == pixels["90-180"]


def test_edits_without_truth_or_without_inserted_objects_are_refused(known, inserts):
    with pytest.raises(DatasetError, match="no image of CAM_FRONT after edit 'another'"):
        measure_edit(checkpoint_of(street_model()), known, JOB, "another", inserts, CPU)
    removed = Edit.model_validate({"steps": [{"remove": {"track": TURNING}}]})
    with pytest.raises(DatasetError, match="edit 'it' inserts no object"):
        measure_edit(checkpoint_of(street_model()), known, JOB.model_copy(update={"edit": removed}), "it", inserts, CPU)
