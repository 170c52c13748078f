"""Ground truth of the key frames of one camera: another view, the leading vehicle removed, depth, instances.

`truth/truth.json` lists the PNGs per key frame. Images are lossless and free of sensor noise. `depth`: 16 bits, units
of 1/256 metre along the optical axis up to 256 m, 0 for the sky (KITTI's convention). `instances`: 8 bits, a key of
`instances`, 0 for scenery. Objects beyond the annotation range have an instance too.
"""

from pathlib import Path

import numpy as np

from drivesplat.demo.recorder import STREET_TO_GLOBAL, Recorder
from drivesplat.demo.rig import DemoSensor, image_height
from drivesplat.demo.tables import token
from drivesplat.readers.truth import TRUTH_FILE, Truth, TruthFrame, write_truth_file
from drivesplat.scene.images import write_png

LEFT = 2.0
"""Distance (metres) of the lateral view to the left of the recorded one."""
DEPTH_UNIT = 256.0


def write_truth_frame(
    root: Path, recorder: Recorder, sensor: DemoSensor, index: int, time_us: int, sample_data: str
) -> TruthFrame:
    """Renders and writes the ground truth of key frame `index`."""
    truth = recorder.truth(sensor, time_us, LEFT)
    depth = np.where(np.isfinite(truth["depth"]), truth["depth"] * DEPTH_UNIT, 0.0)
    images = {
        "lateral": truth["lateral"],
        "without_leading": truth.get("without_leading"),
        "depth": np.clip(depth + 0.5, 0, 65535).astype(np.uint16),
        "instances": np.array([0, *_instance_numbers(recorder)])[truth["objects"] + 1].astype(np.uint8),
    }
    names = {kind: f"{kind}/{index:04}.png" if image is not None else None for kind, image in images.items()}
    for kind, name in names.items():
        if name:
            write_png((root / TRUTH_FILE).parent / name, images[kind])
    poses = {}
    for kind, left in (("", 0.0), ("lateral_", LEFT)):
        camera = recorder.camera(sensor, time_us * 1e-6, left)
        poses[f"{kind}camera_to_global"] = (STREET_TO_GLOBAL @ camera.camera_to_street).tolist()
    return TruthFrame(sample_data, index, **names, **poses)


def _instance_numbers(recorder: Recorder) -> list[int]:
    """The instance number of each object: from 1 for annotated classes, 0 for scenery."""
    annotated = np.array([item.category is not None for item in recorder.objects])
    return (np.cumsum(annotated) * annotated).tolist()


def write_truth(root: Path, recorder: Recorder, scene: str, camera: str, frames: list[TruthFrame]) -> None:
    """Writes truth.json."""
    numbers = zip(_instance_numbers(recorder), recorder.objects, strict=True)
    leading, world = recorder.street.leading, recorder.world
    truth = Truth(
        scene=scene,
        camera=camera,
        width=world.width,
        height=image_height(world.width),
        samples_per_pixel=world.samples_per_pixel,
        lateral_left_m=LEFT,
        leading=token(scene, "instance", leading) if leading else None,
        instances={str(n): token(scene, "instance", item.name) for n, item in numbers if n},
        frames=tuple(frames),
    )
    write_truth_file(root, truth)
