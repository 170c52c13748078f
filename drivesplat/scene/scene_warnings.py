"""Warnings about drives whose metrics are easily misread: the ego vehicle stands, the images are dark, nothing moves.
A warning never stops a run.
"""

import numpy as np
from PIL import Image
from scipy.spatial.distance import pdist

from drivesplat.scene.scene import UNPOSED, Scene
from drivesplat.scene.tracks import moving_tracks

MIN_BASELINE = 1.0
"""Minimum baseline for triangulation, in metres. At this baseline b and nuScenes' focal length f = 1266 pixels, an
error of one pixel displaces a point at depth z = 20 m by a third of a metre (z^2 / (f b))."""
MAX_STANDING_SPEED = 0.3
"""Speed (m/s) up to which the ego vehicle counts as standing; pose errors of centimetres stay below it."""
DARK = 0.2
"""Mean luminance below which images count as dark: nuScenes by day has 0.4, synthetic worlds by night 0.14."""
SAMPLED_IMAGES = 12
"""Number of images from which the luminance of a drive is computed."""
REDUCTION = 8
"""Factor by which these images are reduced on reading."""
REC_709 = np.array([0.2126, 0.7152, 0.0722])
"""Luma weights of red, green and blue (ITU-R BT.709)."""


def max_displacement(scene: Scene) -> float:
    """The largest horizontal distance in metres between two positions of the ego vehicle, without images of its
    LiDAR."""
    if scene.frames:
        every = np.stack([frame.ego_to_world[:2, 3] for frame in scene.frames])
    else:
        _, every = _swept(scene)
    positions = np.unique(every, axis=0)
    return float(pdist(positions).max()) if len(positions) > 1 else 0.0


def standing_time(scene: Scene) -> float:
    """The time in seconds between key frames of the first camera, without images of the first LiDAR, at a speed of at
    most MAX_STANDING_SPEED."""
    if scene.frames:
        frames = [scene.frames[i] for i in scene.key_frames(scene.frames[0].camera)]
        positions = np.stack([frame.ego_to_world[:2, 3] for frame in frames]) if frames else np.zeros((1, 2))
        times = np.array([frame.timestamp for frame in frames])
    else:
        times, positions = _swept(scene)
    seconds = np.diff(times) * 1e-6
    return float(seconds[np.linalg.norm(np.diff(positions, axis=0), axis=1) <= MAX_STANDING_SPEED * seconds].sum())


def _swept(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """The times (n,) in microseconds and horizontal positions (n, 2) of the first LiDAR at key frames."""
    own = [sweep for sweep in scene.sweeps if sweep.is_key_frame and sweep.lidar == scene.sweeps[0].lidar]
    return np.array([sweep.timestamp for sweep in own]), np.stack([sweep.sensor_to_world[:2, 3] for sweep in own])


def duration(scene: Scene) -> float:
    """The time in seconds from the first image to the last, without images of sweeps."""
    times = [recording.timestamp for recording in scene.frames or scene.sweeps]
    return (max(times) - min(times)) * 1e-6


def luminance(scene: Scene) -> float | None:
    """The mean luma in [0, 1] of SAMPLED_IMAGES images spread over the drive, from gamma-coded values; None without
    images."""
    if not scene.frames:
        return None
    chosen = np.unique(np.linspace(0, len(scene.frames) - 1, SAMPLED_IMAGES).round().astype(int))
    lumas = []
    for i in chosen:
        with Image.open(scene.frames[i].image_path) as image:
            image.draft("RGB", (image.width // REDUCTION, image.height // REDUCTION))
            lumas.append(float((np.asarray(image.convert("RGB")) @ REC_709).mean() / 255.0))
    return float(np.mean(lumas))


def scene_warnings(scene: Scene, brightness: float | None) -> list[str]:
    """The warnings of a scene, one sentence each; `brightness` is its `luminance`."""
    found = []
    distance, seconds, stands = max_displacement(scene), duration(scene), standing_time(scene)
    if scene.poses == UNPOSED:
        found.append("there are no poses; refine_poses estimates them from the images")
    elif distance < MIN_BASELINE:
        found.append(
            f"the car hardly moves ({distance:.1f} m in {seconds:.1f} s): nothing can be triangulated, depth is "
            "from LiDAR alone; held-out images repeat training images, so a high PSNR says little, and views from "
            "beside the path are expected to be poor"
            if scene.frames
            else f"the car hardly moves ({distance:.1f} m in {seconds:.1f} s): held-out scans repeat training scans, "
            "so small errors say little"
        )
    elif stands >= 0.5 * seconds:
        recordings = "images" if scene.frames else "scans"
        found.append(
            f"the car stands for {stands:.1f} of {seconds:.1f} s: {recordings} taken there repeat each other, held-out "
            "ones among them"
        )
    if brightness is not None and brightness < DARK:
        found.append(
            f"the images are dark (mean luminance {brightness:.2f}): PSNR is high by night for any rendering; "
            "compare it with the PSNR of a single colour (flat_psnr in metrics.json)"
        )
    if not scene.tracks:
        found.append(
            "nothing is annotated: figures of vehicles are null, and methods with annotated tracks have no actors: "
            "moving objects count as static and smear (docs/without_boxes.md finds them in LiDAR scans)"
        )
    elif not any(track.object_class.is_vehicle for track in moving_tracks(scene)):
        found.append(
            "no vehicle moves: gap_db compares with parked ones (null without them), there is no vehicle to remove or "
            "edit, and a method with actors has none unless actors.humans adds people"
        )
    return found
