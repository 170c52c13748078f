"""The cameras that the service keeps: as many as their bytes allow, each lens computed once, and never one that a call
waits with."""

import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from helpers.patience import wait_until
from helpers.served_drives import pinhole

from drivesplat.drive import cameras
from drivesplat.drive.cameras import PoseableCamera
from drivesplat.serve import camera_specs
from drivesplat.serve.camera_specs import KeptCameras, camera_of
from drivesplat.serve.faults import ServiceError
from drivesplat.serve.messages import wire

WIDTH, HEIGHT = 40, 30


def fisheye(focal: float, name: str = "") -> bytes:
    """A fisheye lens, as in messages."""
    lens = wire.OpenCVFisheyeCameraParam(
        principal_point_x=WIDTH / 2, principal_point_y=HEIGHT / 2, focal_length_x=focal, focal_length_y=focal,
        radial_coeffs=[0.01],
    )  # fmt: skip
    spec = wire.CameraSpec(opencv_fisheye_param=lens, logical_id=name, resolution_w=WIDTH, resolution_h=HEIGHT)
    spec.shutter_type = wire.ShutterType.ROLLING_TOP_TO_BOTTOM
    return spec.SerializeToString(deterministic=True)


def key(focal: float, name: str = "") -> tuple[bytes, int, int, int]:
    return fisheye(focal, name), WIDTH, HEIGHT, 17_000


def arrays_of(camera: PoseableCamera) -> list[np.ndarray]:
    return [each.numpy() for face in camera.faces for each in (face.shows, face.places, face.distance_by_depth)]


def has_lens(camera: PoseableCamera) -> bool:
    """Whether the directions of its lens are in memory."""
    return "faces" in vars(camera)


@pytest.fixture
def computed(monkeypatch) -> list[PoseableCamera]:
    """The lenses whose directions are computed."""
    found, faces_of = [], cameras.faces_of

    def noted(lens, *arguments):
        found.append(lens)
        return faces_of(lens, *arguments)

    monkeypatch.setattr(cameras, "faces_of", noted)
    return found


def test_cameras_are_kept_up_to_a_number_of_bytes(computed):
    alone = KeptCameras()
    expected = arrays_of(alone.camera(key(30.0)))
    one = alone.size
    assert one == sum(array.nbytes for array in expected) + len(fisheye(30.0))
    kept = KeptCameras(max_bytes=int(2.5 * one))
    first, second = (kept.camera(key(focal)) for focal in (30.0, 31.0))
    assert kept.camera(key(30.0)) is first and len(computed) == 3, "the second one is now the one used longest ago"
    third = kept.camera(key(32.0))
    assert kept.size <= 2.5 * one and [has_lens(own) for own in (first, second, third)] == [True, False, True]
    assert kept.camera(key(31.0)) is not second and has_lens(second) is False
    for own, again in zip(arrays_of(first), expected, strict=True):
        np.testing.assert_array_equal(own, again, err_msg="a request that still has a camera computes its lens again")


def test_the_camera_used_last_is_kept_even_if_it_is_larger(computed):
    kept = KeptCameras(max_bytes=1)
    first = kept.camera(key(30.0))
    assert kept.camera(key(30.0)) is first and has_lens(first) and len(computed) == 1
    kept.camera(key(31.0))
    assert not has_lens(first)


def test_names_count_and_so_does_the_number_of_cameras():
    kept = KeptCameras(max_bytes=100_000_000, max_count=3)
    kept.camera(key(30.0))
    before = kept.size
    kept.camera(key(30.0, "n" * 10_000))
    assert kept.size > 2 * before + 9_900
    for focal in (31.0, 32.0, 33.0, 34.0):
        kept.camera(key(focal))
    assert kept.size == 3 * before


def test_a_lens_is_computed_once_and_holds_up_no_pinhole(monkeypatch):
    """Threads that ask for one lens at once wait for the first of them."""
    kept, computed, goes_on = KeptCameras(), [], threading.Event()
    faces_of = cameras.faces_of

    def slow(lens, *arguments):
        computed.append(lens)
        goes_on.wait()
        return faces_of(lens, *arguments)

    monkeypatch.setattr(cameras, "faces_of", slow)
    with ThreadPoolExecutor(4) as threads:
        calls = [threads.submit(kept.camera, key(30.0)) for _ in range(4)]
        try:
            wait_until(lambda: computed)
            spec = wire.CameraSpec.FromString(pinhole().SerializeToString())
            plain = kept.camera((spec.SerializeToString(deterministic=True), 64, 48, 0))
            assert not plain.distorted and not any(call.done() for call in calls)
        finally:
            goes_on.set()
        found = [call.result() for call in calls]
    assert len(computed) == 1 and all(own is found[0] for own in found)


def test_what_is_no_lens_is_not_kept(monkeypatch):
    kept = KeptCameras()
    monkeypatch.setattr(camera_specs, "MAX_PIXELS", 100)
    with pytest.raises(ServiceError, match="resampled from more than 100 pixels"):
        kept.camera(key(30.0))
    assert kept.size == 0


def test_requests_share_the_cameras_of_equal_specifications():
    spec = wire.CameraSpec.FromString(fisheye(30.0))
    assert camera_of(spec, WIDTH, HEIGHT, 17_000) is camera_of(spec, WIDTH, HEIGHT, 17_000)
    assert camera_of(spec, WIDTH, HEIGHT, 18_000) is not camera_of(spec, WIDTH, HEIGHT, 17_000)
