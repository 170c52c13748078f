"""Films: what an independent reader finds in them, their cameras and parts, and every way that ffmpeg can fail."""

import dataclasses
import gc
import json
import os
import resource
import subprocess
import time
import weakref
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest
from helpers.hand_made_street import Reels, a_format, checkpoint_of, street_actors, street_model, street_scene, views_of

from drivesplat.errors import DatasetError, ResultError
from drivesplat.io import video
from drivesplat.io.prefetch import THREADS
from drivesplat.io.video import Footage, read_footage, write_video
from drivesplat.model.background import Background
from drivesplat.model.checkpoint import TrainedCheckpoint
from drivesplat.model.splat_model import SplatModel
from drivesplat.rendering.film import BACKDROP, film_size, render_film, render_parts, write_recorded_frames
from drivesplat.rendering.frames import film_frame
from drivesplat.scene.scene import Scene
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.images import ImageSettings
from drivesplat.settings.render import FilmJob, TrajectorySettings
from drivesplat.settings.train import GaussianSettings, TrainSettings

WIDTH, HEIGHT, FPS = 160, 120, 30
SIZE = (WIDTH, HEIGHT)
CORNERS = {"red": (200, 30, 40), "green": (20, 180, 60), "blue": (30, 40, 220), "white": (250, 250, 250)}
"""The colours of the quarters: top left, top right, bottom left, bottom right."""


def quarters() -> np.ndarray:
    frame = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    for i, color in enumerate(CORNERS.values()):
        rows, columns = divmod(i, 2)
        frame[rows * HEIGHT // 2 :, columns * WIDTH // 2 :] = color
    return frame


def in_quarters(picture: np.ndarray) -> np.ndarray:
    """The values in the middles of the quarters, in the order of `CORNERS`."""
    return np.stack([picture[h, w] for h in (HEIGHT // 4, 3 * HEIGHT // 4) for w in (WIDTH // 4, 3 * WIDTH // 4)])


def noise(count: int) -> Iterator[np.ndarray]:
    """Frames that cannot be compressed."""
    rng = np.random.default_rng(0)
    return (rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8) for _ in range(count))


def decoded(path: Path) -> tuple[dict[str, Any], np.ndarray]:
    """What imageio-ffmpeg reads: its notes, and the frames (n, h, w, 3)."""
    reader = imageio_ffmpeg.read_frames(str(path))
    notes = next(reader)
    width, height = notes["size"]
    return notes, np.stack([np.frombuffer(data, np.uint8).reshape(height, width, 3) for data in reader])


@pytest.fixture
def folder(tmp_path) -> Path:
    """Where films go."""
    path = tmp_path / "films"
    path.mkdir()
    return path


@pytest.fixture
def fake_ffmpeg(tmp_path, monkeypatch):
    """Puts a shell script in ffmpeg's place; in it $FFMPEG is the real one and $out the file to write."""

    def install(script: str) -> None:
        executable = tmp_path / "fake" / "ffmpeg"
        executable.parent.mkdir()
        find_output = 'for word; do case "$word" in file:*) out="${word#file:}";; esac; done'
        real = imageio_ffmpeg.get_ffmpeg_exe()
        executable.write_text(f'#!/bin/bash\nFFMPEG="{real}"\n{find_output}\n{script}\n')
        executable.chmod(0o755)
        monkeypatch.setenv("IMAGEIO_FFMPEG_EXE", str(executable))

    return install


@pytest.fixture
def started(monkeypatch) -> list[subprocess.Popen]:
    """Every process that the test starts."""
    imageio_ffmpeg.get_ffmpeg_exe()  # tries ffmpeg once per process, which is none of the test's business
    processes, popen = [], subprocess.Popen

    def remembered(*args, **kwargs):
        processes.append(popen(*args, **kwargs))
        return processes[-1]

    monkeypatch.setattr(video.subprocess, "Popen", remembered)
    return processes


def assert_nothing_left(folder: Path, started: list[subprocess.Popen]) -> None:
    """No file, whole or half, and no process."""
    assert not list(folder.iterdir())
    for process in started:
        assert process.returncode is not None
        with pytest.raises(ProcessLookupError):
            os.kill(process.pid, 0)


def failure(folder: Path, frames: Iterator[np.ndarray], crf: int = 18) -> str:
    """How the film `street.mp4` fails, in one line that names it."""
    with pytest.raises(ResultError) as error:
        write_video(folder / "street.mp4", frames, SIZE, FPS, crf)
    message = str(error.value)
    assert str(folder / "street.mp4") in message and "\n" not in message
    return message


@pytest.mark.parametrize(("count", "fps"), [(1, 30), (31, 24), (45, 240)])
def test_a_film_has_every_frame_lasts_as_long_and_can_be_played_before_it_is_loaded(folder, count, fps):
    path = folder / "street.mp4"
    write_video(path, noise(count), SIZE, fps, 30)
    notes, frames = decoded(path)
    assert notes["size"] == SIZE and notes["fps"] == fps and notes["codec"].startswith("h264")
    assert len(frames) == count
    assert notes["duration"] == pytest.approx(count / fps, abs=0.006)  # ffmpeg prints hundredths of a second
    assert read_footage(path) == Footage(count, *SIZE, float(fps))
    assert list(folder.iterdir()) == [path]
    content = path.read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


def test_colours_and_orientation_survive_encoding_and_brightness_is_that_of_bt709(folder):
    """ITU-R BT.709 in the narrow range: what a player assumes, whatever the tags say."""
    path = folder / "street.mp4"
    write_video(path, iter([quarters()] * 3), SIZE, FPS, 10)
    notes, frames = decoded(path)
    assert notes["pix_fmt"].replace(" ", "").startswith("yuv420p(tv,bt709,")  # matrix, primaries and curve alike
    for frame in frames:
        np.testing.assert_allclose(in_quarters(frame), list(CORNERS.values()), atol=5)
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", path, "-f", "rawvideo", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    luma = np.frombuffer(raw[: WIDTH * HEIGHT], np.uint8).reshape(HEIGHT, WIDTH)
    expected = 16 + 219 * np.array(list(CORNERS.values())) / 255 @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(in_quarters(luma), expected, atol=2)


def test_memory_does_not_grow_with_the_length_of_a_film(folder):
    alive, most = weakref.WeakSet(), 0

    class Frame(np.ndarray):
        """An array that knows itself by identity, so that it can be counted."""

        __hash__ = object.__hash__

    def frames() -> Iterator[np.ndarray]:
        nonlocal most
        for i in range(200):
            frame = np.full((HEIGHT, WIDTH, 3), i, np.uint8).view(Frame)
            alive.add(frame)
            most = max(most, len(alive))
            yield frame

    write_video(folder / "street.mp4", frames(), SIZE, FPS, 40)
    gc.collect()
    assert 1 <= most <= 3 and len(alive) == 0


@pytest.mark.parametrize(("count", "error"), [(0, RuntimeError("lost")), (40, KeyboardInterrupt())])
def test_frames_that_fail_leave_no_process_no_file_and_an_earlier_film(folder, started, error, count):
    def broken() -> Iterator[np.ndarray]:
        yield from noise(count)
        raise error

    path = folder / "street.mp4"
    for earlier in (None, b"the film before"):
        if earlier:
            path.write_bytes(earlier)
        with pytest.raises(type(error)) as raised:
            write_video(path, broken(), SIZE, FPS, 18)
        assert raised.value is error and len(started) == 1
        if earlier:
            assert path.read_bytes() == earlier
            path.unlink()
        assert_nothing_left(folder, started)
        started.clear()


def test_a_missing_ffmpeg_is_reported(folder, monkeypatch):
    def missing() -> str:
        raise RuntimeError("No ffmpeg exe could be found.")

    monkeypatch.setattr(imageio_ffmpeg, "get_ffmpeg_exe", missing)
    message = failure(folder, noise(3))
    assert "ffmpeg" in message and "No ffmpeg exe could be found" in message and "make setup" in message
    assert_nothing_left(folder, [])


@pytest.mark.parametrize(
    ("script", "fragment"),
    [
        ("echo 'Unknown encoder libx264' >&2; exit 8", "exit status 8: Unknown encoder libx264"),
        ("cat >/dev/null; printf 'one\\n\\ntwo\\nthree\\nfour\\n' >&2; exit 1", "exit status 1: two; three; four"),
        ("head -c 100000 >/dev/null; echo half >\"$out\"; exit 0", "took no more than"),
        ("head -c 100000 >/dev/null; kill -KILL $$", "ended by SIGKILL: it said nothing"),
        ("exec <&-; exec sleep 60", "took no more than"),
        ("head -c 1000000 /dev/zero | tr '\\0' x >&2; exit 3", "exit status 3: xxx"),
        ("exec sleep 60", "took no more"),
        ("cat >/dev/null; exec sleep 60 </dev/null", "an end"),
    ],
    ids=["at once", "at the end", "midway with success", "killed", "closes its input", "wordy", "hangs", "never ends"],
)  # fmt: skip
def test_a_crashing_or_hanging_ffmpeg_is_reported_with_its_last_output(
    folder, started, fake_ffmpeg, monkeypatch, script, fragment
):
    monkeypatch.setattr(video, "PATIENCE", 0.5)
    fake_ffmpeg(script)
    message = failure(folder, noise(40))
    assert "ffmpeg" in message and fragment in message and len(message) < 1200
    assert_nothing_left(folder, started)


@pytest.mark.parametrize(
    ("script", "found"),
    [
        ("cat >/dev/null", "0 frames of 0x0"),
        ('cat >/dev/null; echo nothing >"$out"', "0 frames of 0x0"),
        ('"$FFMPEG" "$@"; head -c 40000 "$out" >"$out.cut"; mv "$out.cut" "$out"', "frames of 160x120"),
        (f'(head -c {7 * WIDTH * HEIGHT * 3}; cat >/dev/null) | "$FFMPEG" "$@"', "7 frames of 160x120 at 30 fps"),
        ('"$FFMPEG" "${@/#30/15}"', "20 frames of 160x120 at 15 fps"),
        ('"$FFMPEG" "${@/#160x120/120x160}"', "20 frames of 120x160 at 30 fps"),
    ],
    ids=["no file", "no film", "truncated", "frames lost", "other rate", "other size"],
)  # fmt: skip
def test_a_film_that_differs_from_its_input_is_detected(folder, started, fake_ffmpeg, script, found):
    fake_ffmpeg(script)
    given, wrote = failure(folder, noise(20)).split(" and wrote ")
    assert given.endswith("20 frames of 160x120 at 30 fps")
    assert found in wrote and not wrote.startswith("20 frames of 160x120 at 30 fps")
    assert_nothing_left(folder, started)


def test_a_full_disk_is_reported(folder, started):
    """A limit on the size of files stands for the full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        message = failure(folder, noise(60), crf=0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "ffmpeg" in message and "free disk space" in message
    assert_nothing_left(folder, started)


BALL = np.array([30.0, 1.0, 1.5])
"""Where the models of these tests have their one white Gaussian: world coordinates, ahead of the tiny drive."""


def a_checkpoint() -> TrainedCheckpoint:
    """What a training leaves: one white ball in the dark."""
    settings = TrainSettings(gaussians=GaussianSettings(sh_degree=1, init_opacity=0.9))
    part = Background.from_points(BALL[None].astype(np.float32), np.ones((1, 3)), settings.gaussians, 1.0)
    part.params["scales"].data.fill_(np.log(0.4))
    return checkpoint_of(SplatModel([part], None), settings)


def a_job(**changes: Any) -> FilmJob:
    values = {
        "camera": "CAM_FRONT", "trajectory": TrajectorySettings(), "fps": 10, "width": WIDTH, "height": HEIGHT,
        "horizontal_fov": None, "crf": 5,
    }  # fmt: skip
    return FilmJob(**(values | changes))


@pytest.mark.parametrize(
    ("recorded", "images", "given", "expected"),
    [
        ((400, 225), None, {}, (400, 224)), ((1242, 375), None, {}, (1242, 376)),
        ((3840, 2160), None, {}, (1920, 1080)), ((1080, 1920), None, {}, (1080, 1920)),
        ((1600, 900), 400, {}, (400, 224)), ((1600, 900), 400, {"width": 1920}, (1920, 1080)),
        ((1600, 900), None, {"height": 450}, (800, 450)),
        ((400, 225), None, {"width": 576, "height": 324}, (576, 324)), ((4000, 20), 200, {}, (200, 16)),
    ],
)  # fmt: skip
def test_a_film_is_as_large_as_the_training_images_unless_the_settings_say_otherwise(
    tiny_scene, recorded, images, given, expected
):
    frame = dataclasses.replace(tiny_scene.frames[0], width=recorded[0], height=recorded[1])
    job = a_job(**{"width": None, "height": None, "images": ImageSettings(width=images)} | given)
    assert film_size(dataclasses.replace(tiny_scene, frames=(frame,)), job) == expected


def filmed(scene: Scene, path: Path, job: FilmJob) -> dict[str, Any]:
    return render_film(scene, a_checkpoint(), job, DeviceSettings(kind="cpu"), path)


def middle_of_light(frame: np.ndarray) -> np.ndarray:
    """The centre of a frame's brightness in continuous pixels (x, y)."""
    brightness = np.clip(frame.astype(float).mean(axis=2) - 20.0, 0.0, None)
    y, x = np.mgrid[: frame.shape[0], : frame.shape[1]] + 0.5
    return np.array([(x * brightness).sum(), (y * brightness).sum()]) / brightness.sum()


@pytest.mark.parametrize(
    "changes",
    [
        {"trajectory": TrajectorySettings(lateral=2.0, vertical=0.5)},
        {"trajectory": TrajectorySettings(yaw=-8.0), "horizontal_fov": 50.0},
    ],
    ids=["aside", "turned"],
)
def test_the_record_of_a_film_has_its_duration_and_the_cameras_it_was_rendered_with(folder, tiny_scene, changes):
    """The ball is where pinhole, K and pose of the record put it, in every frame."""
    path, job = folder / "street.mp4", a_job(**changes)
    record = json.loads(json.dumps(filmed(tiny_scene, path, job)))
    notes, frames = decoded(path)
    assert len(frames) == record["frames"] == len(record["camera_to_world"])
    for frame, camera_to_world in zip(frames, record["camera_to_world"], strict=True):
        x, y, z, _ = np.linalg.inv(camera_to_world) @ [*BALL, 1.0]
        expected = np.array(record["K"]) @ [x / z, y / z, 1.0]
        np.testing.assert_allclose(middle_of_light(frame), expected[:2], atol=0.3)
    times = [frame.timestamp for frame in tiny_scene.frames]
    assert (max(times) - min(times)) == 4_500_000
    assert notes["duration"] == pytest.approx(4.5 + 1 / 10, abs=0.01)
    plain = {key: record[key] for key in ("schema", "camera", "fps", "width", "height", "frames", "duration_s")}
    assert plain == {
        "schema": 1, "camera": "CAM_FRONT", "fps": 10, "width": WIDTH, "height": HEIGHT, "frames": 46, "duration_s": 4.6
    }  # fmt: skip
    assert record["timestamps"] == [min(times) + 100_000 * k for k in range(46)]
    assert record["origin"] == tiny_scene.origin.tolist()
    asked = job.trajectory
    assert record["offset"] == {"lateral": asked.lateral, "vertical": asked.vertical, "yaw": asked.yaw}
    assert record["bytes"] == path.stat().st_size and record["render_seconds"] > 0


def test_a_camera_that_the_scene_lacks_is_refused_before_any_output(folder, tiny_scene):
    with pytest.raises(DatasetError, match="CAM_BACK"):
        filmed(tiny_scene, folder / "street.mp4", a_job(camera="CAM_BACK"))
    assert not list(folder.iterdir())


CPU = DeviceSettings(kind="cpu")


@pytest.fixture(scope="module")
def scene(tiny_scene) -> Scene:
    return street_scene(tiny_scene)


@pytest.fixture
def reels(monkeypatch) -> Reels:
    made = Reels()
    monkeypatch.setattr("drivesplat.rendering.film.write_video", made)
    return made


def parts_film(scene: Scene, folder: Path, checkpoint: TrainedCheckpoint, **changes: Any) -> dict[str, Any]:
    return render_parts(scene, checkpoint, a_format(**changes), CPU, folder / "parts.mp4")


def test_scene_static_and_dynamic_parts_are_side_by_side(scene, tmp_path, reels):
    """Each third is what a model of these parts alone shows, and a film of them; dynamic parts stand before grey
    instead of the sky."""
    whole = street_model()
    still, actors = street_model(whole.parts[0]), SplatModel([street_actors()], None).requires_grad_(False)
    checkpoint = checkpoint_of(whole)
    record = parts_film(scene, tmp_path, checkpoint)
    views = views_of(record, scene)
    assert (record["shows"], len(reels["parts"])) == (["all", "still", "moving"], len(views))
    thirds = np.split(reels["parts"], 3, axis=2)
    for everything, without, alone, view in zip(*thirds, views, strict=True):
        np.testing.assert_array_equal(everything, film_frame(whole, view))
        np.testing.assert_array_equal(without, film_frame(still, view))
        shown = actors.render(view)
        expected = shown.splats + BACKDROP * (1 - shown.alpha[..., None])
        np.testing.assert_allclose(alone, 255 * expected.clamp(max=1.0), atol=0.51)
    assert 0.3 < (thirds[2] == round(255 * BACKDROP)).all(axis=-1).mean() < 0.9
    for parts, panel in zip(("all", "static", "moving"), thirds, strict=True):
        job = FilmJob(**a_format().model_dump(), trajectory=TrajectorySettings(parts=parts))
        some = render_film(scene, checkpoint, job, CPU, tmp_path / "some.mp4")
        np.testing.assert_array_equal(reels["some"], panel)
        assert some["parts"] == parts and "parts" not in some["offset"]


@pytest.fixture(scope="module")
def frames_file(scene, tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("frames") / "recorded_frames.npy"
    write_recorded_frames(scene, checkpoint_of(street_model()), a_format(), CPU, path)
    return path


def test_films_are_the_same_with_frames_rendered_before(scene, tmp_path, reels, frames_file):
    checkpoint, job = checkpoint_of(street_model()), FilmJob(**a_format().model_dump(), trajectory=TrajectorySettings())
    render_film(scene, checkpoint, job, CPU, tmp_path / "film.mp4")
    render_film(scene, checkpoint, job, CPU, tmp_path / "film_of_file.mp4", frames_file)
    parts_film(scene, tmp_path, checkpoint)
    render_parts(scene, checkpoint, a_format(), CPU, tmp_path / "parts_of_file.mp4", frames_file)
    np.testing.assert_array_equal(np.load(frames_file), reels["film"])
    np.testing.assert_array_equal(reels["film_of_file"], reels["film"])
    np.testing.assert_array_equal(reels["parts_of_file"], reels["parts"])


def test_films_show_the_frames_of_the_file_and_refuse_those_of_another_film(scene, tmp_path, reels, frames_file):
    frames, path = 255 - np.load(frames_file), tmp_path / "recorded_frames.npy"
    job = FilmJob(**a_format().model_dump(), trajectory=TrajectorySettings())

    def film_of(content: np.ndarray) -> None:
        np.save(path, content)
        render_film(scene, checkpoint_of(street_model()), job, CPU, tmp_path / "film.mp4", path)

    film_of(np.concatenate([frames, frames]))  # of a longer film
    np.testing.assert_array_equal(reels["film"], frames)
    for content in (frames[:-1], frames[:, :-2], frames.astype(np.float32)):
        with pytest.raises(ResultError, match=r"recorded_frames\.npy: contains .* delete it and rerun"):
            film_of(content)
    path.write_bytes(frames_file.read_bytes()[:100])
    with pytest.raises(ResultError, match=r"recorded_frames\.npy: no file of frames"):
        render_film(scene, checkpoint_of(street_model()), job, CPU, tmp_path / "film.mp4", path)


def test_rendering_does_not_run_far_ahead_of_the_encoder(scene, tmp_path, monkeypatch):
    rendered = []
    monkeypatch.setattr(
        "drivesplat.rendering.film.film_frame", lambda *_: rendered.append(1) or np.zeros((36, 64, 3), np.uint8)
    )

    def encoder(path, frames, size, fps, crf, threads):
        frames = iter(frames)
        next(frames)
        time.sleep(0.05)
        assert 2 <= len(rendered) <= 2 * (1 + THREADS + 1)
        assert len([*frames]) > 2 * THREADS
        path.write_bytes(b"")

    monkeypatch.setattr("drivesplat.rendering.film.write_video", encoder)
    parts_film(scene, tmp_path, checkpoint_of(street_model()))
