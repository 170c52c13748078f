"""Circumstances of a drive under which figures say less than they seem to: a car that stands, darkness, a street on
which nothing moves. What is said of them is a finding, never a gate.
"""

import numpy as np
from PIL import Image
from scipy.spatial.distance import pdist

from drivesplat.scene.scene import Scene
from drivesplat.scene.tracks import moving_tracks

MIN_BASELINE = 1.0
"""Metres. From images that lie this far apart, a point 20 m away and off by a pixel is off by a third of a metre in
depth at nuScenes' focal length (z^2 / (f b), f = 1266 pixels); from less than that, geometry is LiDAR's alone."""
STANDS = 0.3
"""Metres a second up to which a car stands; poses that err by centimetres creep."""
DARK = 0.2
"""Mean luminance under which images are dark: nuScenes by day has 0.4, synthetic worlds by night have 0.14."""
LOOKS = 12
"""So many images tell how bright a drive is."""
REDUCED = 8
"""They are read at this fraction of their size."""
REC_709 = np.array([0.2126, 0.7152, 0.0722])
"""Luma weights of red, green and blue (ITU-R BT.709)."""


def moved(scene: Scene) -> float:
    """How far apart, in metres over the ground, the two places lie between which the car was farthest apart."""
    places = np.unique(np.stack([frame.ego_to_world[:2, 3] for frame in scene.frames]), axis=0)
    return float(pdist(places).max()) if len(places) > 1 else 0.0


def standing(scene: Scene) -> float:
    """For how many seconds the car, from key frame to key frame of the first camera, is no faster than STANDS."""
    frames = [scene.frames[i] for i in scene.key_frames(scene.frames[0].camera)]
    places = np.stack([frame.ego_to_world[:2, 3] for frame in frames]) if frames else np.zeros((1, 2))
    seconds = np.diff([frame.timestamp for frame in frames]) * 1e-6
    return float(seconds[np.linalg.norm(np.diff(places, axis=0), axis=1) <= STANDS * seconds].sum())


def seconds_long(scene: Scene) -> float:
    """The time from the first image to the last."""
    times = [frame.timestamp for frame in scene.frames]
    return (max(times) - min(times)) * 1e-6


def luminance(scene: Scene) -> float:
    """The mean luma of LOOKS images spread over the drive, in [0, 1] of the recorded (gamma-coded) values."""
    chosen = np.unique(np.linspace(0, len(scene.frames) - 1, LOOKS).round().astype(int))
    return float(np.mean([_luma(scene.frames[i].image_path) for i in chosen]))


def _luma(path: str) -> float:
    with Image.open(path) as image:
        image.draft("RGB", (image.width // REDUCED, image.height // REDUCED))
        return float((np.asarray(image.convert("RGB")) @ REC_709).mean() / 255.0)


def scene_warnings(scene: Scene, brightness: float) -> list[str]:
    """What to know before the figures of a scene are read, a sentence a circumstance; `brightness` is `luminance`."""
    found = []
    distance, seconds, stands = moved(scene), seconds_long(scene), standing(scene)
    if distance < MIN_BASELINE:
        found.append(
            f"the car hardly moves ({distance:.1f} m in {seconds:.1f} s): nothing can be triangulated, depth is "
            "LiDAR's alone; held-out images show what training images show: expect a PSNR that is high and says "
            "little, and views from beside the path that fall apart"
        )
    elif stands >= 0.5 * seconds:
        found.append(
            f"the car stands for {stands:.1f} of {seconds:.1f} s: images taken there repeat each other, held-out ones "
            "among them"
        )
    if brightness < DARK:
        found.append(
            f"the images are dark (mean luminance {brightness:.2f}): PSNR is high by night whatever is rendered; "
            "compare it with what one colour alone reaches (flat_psnr in metrics.json)"
        )
    if not scene.tracks:
        found.append(
            "nothing is annotated (the test split of nuScenes has no boxes): what moves counts as static and smears"
        )
    elif not any(track.object_class.is_vehicle for track in moving_tracks(scene)):
        found.append(
            "no vehicle moves: gap_db compares with parked ones (null without them), there is no vehicle to remove or "
            "edit, and a method with actors has none but what actors.humans may add"
        )
    return found
