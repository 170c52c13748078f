"""The light of a scene is found from the ground beside vehicles, and only where their shadows are clear."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from drivesplat.errors import ResultError
from drivesplat.io.storage import no_provenance
from drivesplat.preprocess.light import MIN_PLACES, Places, estimate_light, light_of
from drivesplat.scene.light import (
    OVERCAST,
    SceneLight,
    contact_shadow,
    direction,
    hides_sun,
    read_light,
    write_light,
)
from drivesplat.settings.images import HoldoutSettings, ImageSettings, LightJob

SIZE = np.array([4.5, 1.9, 1.5])


def places(light: SceneLight, count: int = 6000, noise: float = 0.1) -> Places:
    """Places about cars that face all ways, and what they lose in this light."""
    random = np.random.default_rng(0)
    points = np.column_stack(
        [random.uniform(-(SIZE[:2] / 2 + 3), SIZE[:2] / 2 + 3, (4 * count, 2)), np.zeros(4 * count)]
    )
    points[:, 2] = -SIZE[2] / 2
    points = points[(np.abs(points[:, :2]) > SIZE[:2] / 2).any(axis=1)][:count]
    rotations = Rotation.from_euler("z", random.uniform(0.0, 2.0 * np.pi, (count, 1))).as_matrix()
    sizes = np.tile(SIZE, (count, 1))
    lost = light.contact * contact_shadow(points, sizes) + random.normal(0.0, noise, count)
    if light.sun is not None:
        lost += light.cast * hides_sun(points, sizes, np.einsum("j,njk->nk", light.sun, rotations))
    return Places(points, sizes, rotations, lost)


def test_the_sun_is_found_by_the_shadows_of_boxes():
    found = light_of(places(SceneLight(0.1, 0.4, 195.0, 40.0)))
    assert (found.azimuth_deg, found.elevation_deg) == (195.0, 40.0)
    assert found.cast == pytest.approx(0.4, abs=0.03) and found.contact == pytest.approx(0.1, abs=0.03)
    assert "sun at 195, 40 degrees" in found.in_words


def test_without_clear_shadows_there_is_no_sun():
    found = light_of(places(SceneLight(0.2)))
    assert found.sun is None and found.cast == 0.0 and found.contact == pytest.approx(0.2, abs=0.03)
    assert "no shadow of a sun" in found.in_words
    weak = light_of(places(SceneLight(0.2, 0.05, 90.0, 40.0)))
    assert weak.sun is None, "a shadow that is hardly seen tells no direction"


def test_a_box_hides_the_sun_on_its_far_side_and_darkens_the_ground_at_its_rim():
    sun = direction(90.0, 45.0)
    np.testing.assert_allclose(sun, [0.0, np.sqrt(0.5), np.sqrt(0.5)], atol=1e-12)
    beside = np.array([[0.0, -1.3, -0.75], [0.0, 1.3, -0.75], [0.0, -2.8, -0.75], [3.0, -1.3, -0.75]])
    sizes = np.tile(SIZE, (4, 1))
    assert hides_sun(beside, sizes, np.tile(sun, (4, 1))).tolist() == [True, False, False, False]
    strength = contact_shadow(beside, sizes)
    assert strength[0] == strength[1] > strength[2] and contact_shadow(np.zeros((1, 3)), sizes[:1])[0] == 1.0


def test_a_scene_that_shows_too_little_ground_is_overcast(tiny_scene, tmp_path):
    image = tmp_path / "grey.png"
    frame = tiny_scene.frames[0]
    Image.fromarray(np.full((frame.height, frame.width, 3), 90, dtype=np.uint8)).save(image)
    frames = tuple(replace(one, image_path=str(image)) for one in tiny_scene.frames)
    job = LightJob(holdout=HoldoutSettings(), images=ImageSettings(width=64))
    assert estimate_light(replace(tiny_scene, frames=frames, tracks=()), job) == OVERCAST
    assert MIN_PLACES > 0


def test_a_file_holds_the_light_and_another_is_refused(tmp_path):
    path = tmp_path / "light.json"
    for light in (OVERCAST, SceneLight(0.05, 0.3, 120.0, 50.0)):
        write_light(path, light, no_provenance())
        assert read_light(path) == light
    for values, fault in {
        '"dark", "cast": 0, "azimuth_deg": null, "elevation_deg": null': "could not convert",
        '7, "cast": 0, "azimuth_deg": null, "elevation_deg": null': "shares from 0 to 1",
        '0.1, "cast": 0.3, "azimuth_deg": 10, "elevation_deg": 0': "the sun stands at 0 degrees",
    }.items():
        path.write_text(f'{{"contact": {values}}}')
        with pytest.raises(ResultError, match=rf"light\.json: not the light of a scene \(.*{fault}"):
            read_light(path)
