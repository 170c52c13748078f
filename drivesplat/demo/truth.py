"""The truth that real logs lack, for the key frames of one camera: another view, an absent car, depth, instances.

`truth/truth.json` lists per key frame the PNGs beside it. Images are lossless and free of sensor noise. `depth`: 16
bits, 1/256 metre along the camera's axis up to 256 m, 0 for the sky (KITTI's convention). `instances`: 8 bits, a number
of `instances`, 0 for scenery; cars and people too far away for a box have numbers as well.
"""

from pathlib import Path

import numpy as np
from PIL import Image

from drivesplat.demo.recorder import STREET_TO_GLOBAL, Recorder
from drivesplat.demo.rig import Sensor, height_of
from drivesplat.demo.tables import token
from drivesplat.io.storage import atomic_write
from drivesplat.readers.truth import TRUTH_FILE, Truth, TruthFrame, write_truth_file

LEFT = 2.0
"""How far (metres) to the own car's left the other view lies."""
DEPTH_UNIT = 256.0


def write_truth_frame(
    root: Path, recorder: Recorder, sensor: Sensor, index: int, time_us: int, sample_data: str
) -> TruthFrame:
    """Renders and writes the truth of key frame `index`."""
    truth = recorder.truth(sensor, time_us, LEFT)
    depth = np.where(np.isfinite(truth["depth"]), truth["depth"] * DEPTH_UNIT, 0.0)
    numbers = np.array([0, *_instance_numbers(recorder)])[truth["things"] + 1]
    images = {
        "lateral": truth["lateral"],
        "without_leading": truth.get("without_leading"),
        "depth": np.clip(depth + 0.5, 0, 65535).astype(np.uint16),
        "instances": numbers.astype(np.uint8),
    }
    names = {}
    for kind, image in images.items():
        names[kind] = f"{kind}/{index:04}.png" if image is not None else None
        if image is not None:
            with atomic_write((root / TRUTH_FILE).parent / names[kind]) as file:
                Image.fromarray(image).save(file, "PNG")
    poses = {}
    for kind, left in (("", 0.0), ("lateral_", LEFT)):
        camera = recorder.camera(sensor, time_us * 1e-6, left)
        poses[f"{kind}camera_to_global"] = (STREET_TO_GLOBAL @ camera.camera_to_street).tolist()
    return TruthFrame(sample_data, index, **names, **poses)


def _instance_numbers(recorder: Recorder) -> list[int]:
    """Per thing its number in `instances`: from 1 on for what carries boxes, 0 for scenery."""
    boxed = np.array([thing.category is not None for thing in recorder.things])
    return (np.cumsum(boxed) * boxed).tolist()


def write_truth(root: Path, recorder: Recorder, scene: str, camera: str, frames: list[TruthFrame]) -> None:
    """Writes truth.json."""
    numbers = zip(_instance_numbers(recorder), recorder.things, strict=True)
    leading = recorder.street.leading
    write_truth_file(
        root,
        Truth(
            scene=scene,
            camera=camera,
            width=recorder.world.width,
            height=height_of(recorder.world.width),
            samples_per_pixel=recorder.world.samples_per_pixel,
            lateral_left_m=LEFT,
            leading=token(scene, "instance", leading) if leading else None,
            instances={str(n): token(scene, "instance", thing.name) for n, thing in numbers if n},
            frames=tuple(frames),
        ),
    )
