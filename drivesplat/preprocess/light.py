"""The stage `light`: the light of a scene, from the shadows that recorded vehicles cast.

Ground beside a vehicle is compared with ground farther ahead and behind it at the same distance from the vehicle's
axis: lanes, kerbs and sidewalks mostly run along vehicles. The direction of the sun is the one whose shadows of boxes
explain most of what ground lost.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from drivesplat.io.prefetch import prefetch
from drivesplat.scene.images import continuous_intrinsics, read_image, target_size
from drivesplat.scene.light import OVERCAST, SceneLight, contact_shadow, direction, hides_sun
from drivesplat.scene.regions import labelled_hulls
from drivesplat.scene.rigid import apply, inverse
from drivesplat.scene.scene import Frame, Scene
from drivesplat.scene.splits import training_images
from drivesplat.scene.tracks import Box, box_at
from drivesplat.settings.images import LightJob

POINTS = 1500
"""Places on the ground about each vehicle in each image."""
BESIDE, AHEAD, GAP = 4.0, 8.0, 2.5
"""Metres about a box in which ground is looked at to its sides and along it, and from where along it ground counts as
unshaded."""
STRIP = 0.3
"""Metres by which compared places may differ in their distance from the vehicle's axis."""
MIN_COMPARED = 4
MAX_IMAGES = 200
MAX_DISTANCE = 35.0
"""Metres from the camera up to which a vehicle counts."""
MAX_LOSS = 0.6
"""Losses of brightness are limited to this, so that markings and kerbs count little."""
ELEVATIONS_DEG, AZIMUTH_STEP_DEG = (20.0, 30.0, 40.0, 50.0, 60.0, 70.0), 15.0
MIN_PLACES, MIN_CAST, MIN_GAIN = 2000, 0.12, 1.5
"""A sun is only known from so many places, with shadows of this strength, that explain so many times as much as contact
shadows alone."""


class Places(NamedTuple):
    """Places on the ground: in the frames of boxes (n, 3) of `sizes` (n, 3), the rotations (n, 3, 3) of these to the
    world, and the share of brightness `lost` (n,) against ground nearby."""

    points: Float[np.ndarray, "n 3"]
    sizes: Float[np.ndarray, "n 3"]
    rotations: Float[np.ndarray, "n 3 3"]
    lost: Float[np.ndarray, " n"]


def estimate_light(scene: Scene, job: LightJob) -> SceneLight:
    """The light of a scene by its training images; OVERCAST where they show too little ground about vehicles."""
    random, images = np.random.default_rng(0), training_images(scene, job.holdout)
    chosen = images[np.unique(np.linspace(0, len(images) - 1, MAX_IMAGES).astype(int))] if len(images) else images
    frames = [(scene.frames[i], int(random.integers(2**31))) for i in chosen]

    def seen_in(one: tuple[Frame, int]) -> list[Places]:
        return list(_places(scene, one[0], job, np.random.default_rng(one[1])))

    found = [places for several in prefetch(seen_in, frames) for places in several]
    if sum(len(places.lost) for places in found) < MIN_PLACES:
        return OVERCAST
    return light_of(Places(*(np.concatenate(values) for values in zip(*found, strict=True))))


def light_of(places: Places) -> SceneLight:
    """The light that explains what places lost.

    The losses are fitted by the contact shadow and, for each direction of the sun, by the shadow of the box, both with
    factors from 0 on (non-negative least squares).
    """
    contact = contact_shadow(places.points, places.sizes)
    total = float((places.lost**2).sum())
    (alone,), rest = nnls(contact[:, None], places.lost)
    gain, best = max(total - rest**2, 1e-9 * total), SceneLight(float(alone))
    explained = gain
    for azimuth in np.arange(0.0, 360.0, AZIMUTH_STEP_DEG):
        for elevation in ELEVATIONS_DEG:
            sun = np.einsum("j,njk->nk", direction(azimuth, elevation), places.rotations)
            hidden = hides_sun(places.points, places.sizes, sun).astype(np.float64)
            (cast, rim), rest = nnls(np.column_stack([hidden, contact]), places.lost)
            known = total - rest**2
            if cast >= MIN_CAST and known > explained and known > MIN_GAIN * gain:
                explained, best = known, SceneLight(float(rim), float(cast), float(azimuth), float(elevation))
    return best


def _places(scene: Scene, frame: Frame, job: LightJob, random: np.random.Generator) -> Iterator[Places]:
    """The places on the ground about each vehicle that an image shows."""
    size = target_size(frame, job.images)
    gray = read_image(frame.image_path, size).mean(axis=2) / 255.0
    K, world_to_camera = continuous_intrinsics(frame, size), inverse(frame.camera_to_world)
    boxes = (box_at(track, frame.timestamp, scene.key_frame_interval) for track in scene.tracks)
    known = [box for box in boxes if box is not None and box.object_class.is_dynamic]
    covered = labelled_hulls(scene, frame, size)[1] >= 0
    for box in known:
        far = np.linalg.norm(apply(world_to_camera, box.object_to_world[None, :3, 3])[0]) > MAX_DISTANCE
        if box.object_class.is_vehicle and not far:
            yield _about(box, [other for other in known if other is not box], gray, covered, K, world_to_camera, random)


def _about(
    box: Box, others: list[Box], gray: np.ndarray, covered: np.ndarray, K: np.ndarray, world_to_camera: np.ndarray,
    random: np.random.Generator,
) -> Places:  # fmt: skip
    """The places about one box in an image of grey levels, outside of what boxes have `covered`."""
    length, width, height = box.size
    reach = np.array([length / 2 + AHEAD, width / 2 + BESIDE])
    points = np.column_stack([random.uniform(-reach, reach, (POINTS, 2)), np.full(POINTS, -height / 2)])
    points = points[(np.abs(points[:, :2]) > box.size[:2] / 2).any(axis=1)]
    world = apply(box.object_to_world, points)
    in_camera = apply(world_to_camera, world)
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (in_camera / in_camera[:, 2:]) @ K.T
    shown = (in_camera[:, 2] > 2.0) & (pixels[:, :2] >= 0.0).all(axis=1)
    shown &= (pixels[:, :2] < np.array(gray.shape[::-1])).all(axis=1)
    for other in others:  # their shadows are near them
        local = apply(inverse(other.object_to_world), world)
        shown &= (np.abs(local[:, :2]) > other.size[:2] / 2 + 1.5).any(axis=1)
    points, (u, v) = points[shown], pixels[shown, :2].astype(int).T
    free = ~covered[v, u]
    points, levels = points[free], gray[v[free], u[free]]
    along = np.abs(points[:, 0]) > length / 2 + GAP
    lost, kept = [], []
    for i in np.flatnonzero(~along):
        compared = levels[along & (np.abs(points[:, 1] - points[i, 1]) < STRIP)]
        if len(compared) >= MIN_COMPARED:
            kept.append(i)
            lost.append(1.0 - levels[i] / max(float(np.median(compared)), 1e-3))
    count = len(kept)
    rotation = box.object_to_world[:3, :3]
    return Places(
        points[kept].reshape(-1, 3), np.tile(box.size, (count, 1)), np.tile(rotation, (count, 1, 1)),
        np.clip(np.array(lost), -MAX_LOSS, MAX_LOSS),
    )  # fmt: skip
