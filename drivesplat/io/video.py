"""H.264 films: written through ffmpeg, then read again by another reader before they count.

ffmpeg is imageio-ffmpeg's; IMAGEIO_FFMPEG_EXE names another.
"""

import signal
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from threading import Timer
from typing import BinaryIO

import cv2
import ffmpeg
import imageio_ffmpeg
import numpy as np

from drivesplat.errors import ResultError
from drivesplat.io.storage import atomic_path

PATIENCE = 600.0
"""Seconds that ffmpeg may take over one frame, or over the end of a film, before it counts as hung."""


@dataclass(frozen=True)
class Footage:
    """What a film holds: its number of frames, their size in pixels, and frames per second."""

    frames: int
    width: int
    height: int
    fps: float

    def __str__(self) -> str:
        return f"{self.frames} frames of {self.width}x{self.height} at {self.fps:g} fps"


def write_video(
    path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], fps: int, crf: int, threads: int = 0
) -> None:
    """An MP4 of `frames` (h, w, 3) uint8 RGB, taken one at a time; `size` is width and height, both even. `threads`
    encode, 0: as many as ffmpeg likes.

    Raises ResultError, leaving no file, where ffmpeg is missing, fails, or wrote anything but what it was given.
    """
    with atomic_path(path) as aside:
        count = _encode(path, frames, size, _command(path, aside, size, fps, crf, threads))
        given, found = Footage(count, *size, float(fps)), read_footage(aside)
        if found != given:
            raise ResultError(f"{path}: ffmpeg was given {given} and wrote {found}; free disk space and rerun")


def read_footage(path: Path) -> Footage:
    """What OpenCV finds in a film when it decodes every frame; all zero where it finds no film."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        width, height = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH)), int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        fps = round(capture.get(cv2.CAP_PROP_FPS), 3)
        frames = 0
        while capture.grab():
            frames += 1
        return Footage(frames, width, height, fps)
    finally:
        capture.release()


def _command(path: Path, aside: Path, size: tuple[int, int], fps: int, crf: int, threads: int) -> list[str]:
    try:
        executable = imageio_ffmpeg.get_ffmpeg_exe()
    except RuntimeError as error:
        raise _not_started(path, error) from error
    pictures = ffmpeg.input("pipe:", format="rawvideo", pix_fmt="rgb24", s=f"{size[0]}x{size[1]}", framerate=fps)
    # unasked, ffmpeg turns RGB into YUV by BT.601's matrix, and players turn it back by BT.709's: every colour is off.
    # Newer ones tag a film with what its frames say (setparams), older ones with what the output's options say.
    bt709 = {"colorspace": "bt709", "color_primaries": "bt709", "color_trc": "bt709"}
    converted = (
        pictures.filter("scale", out_color_matrix="bt709", out_range="tv", flags="bicubic+accurate_rnd+full_chroma_int")
        .filter("format", "yuv420p")
        .filter("setparams", range="tv", **bt709)
    )
    film = converted.output(
        f"file:{aside}",
        format="mp4",
        vcodec="libx264",
        crf=crf,
        movflags="+faststart",
        threads=threads,
        color_range="tv",
        **bt709,
    ).global_args("-hide_banner", "-nostdin", "-nostats", "-loglevel", "error")
    return ffmpeg.compile(film, cmd=executable, overwrite_output=True)


def _encode(path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], command: list[str]) -> int:
    """Gives ffmpeg every frame and sees it end well; returns how many. ffmpeg is gone afterwards, come what may."""
    count = 0
    # messages into a file: a pipe that nobody empties fills up, and ffmpeg would wait for ever
    with TemporaryFile() as messages, _running(path, command, messages) as process:
        for frame in frames:
            if frame.shape != (size[1], size[0], 3) or frame.dtype != np.uint8:
                raise ValueError(f"a frame of {frame.shape} {frame.dtype} in a film of {size[0]}x{size[1]}")
            if not _taken(process, frame):
                _wait(process, min(10.0, PATIENCE))
                raise _failed(path, f"took no more than {count} frames", process, messages)
            count += 1
        process.stdin.close()
        _wait(process, PATIENCE)
        if process.returncode != 0:
            how = "did not come to an end" if process.returncode is None else f"failed after {count} frames"
            raise _failed(path, how, process, messages)
    return count


@contextmanager
def _running(path: Path, command: list[str], messages: BinaryIO) -> Iterator[subprocess.Popen]:
    try:
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=messages)
    except OSError as error:
        raise _not_started(path, error) from error
    try:
        yield process
    finally:
        process.kill()
        process.wait()
        with suppress(OSError):
            process.stdin.close()


def _taken(process: subprocess.Popen, frame: np.ndarray) -> bool:
    """Whether ffmpeg read the frame, rather than ending, closing its input or hanging."""
    watchdog = Timer(PATIENCE, process.kill)
    watchdog.start()
    try:
        process.stdin.write(np.ascontiguousarray(frame).data)
        process.stdin.flush()
    except BrokenPipeError:
        return False
    finally:
        watchdog.cancel()
    return True


def _wait(process: subprocess.Popen, seconds: float) -> None:
    with suppress(subprocess.TimeoutExpired):
        process.wait(seconds)


def _not_started(path: Path, error: Exception) -> ResultError:
    return ResultError(
        f"{path}: ffmpeg, which writes it, cannot be started ({error}); "
        "run `make setup`, or name an ffmpeg with libx264 in the environment variable IMAGEIO_FFMPEG_EXE"
    )


def _failed(path: Path, what: str, process: subprocess.Popen, messages: BinaryIO) -> ResultError:
    """`what` ffmpeg did, how it ended, and the last it said."""
    status = process.poll()
    ending = "still running" if status is None else f"exit status {status}"
    if status is not None and status < 0:
        ending = f"ended by {signal.Signals(-status).name}"
    messages.seek(0)
    said = [line.strip() for line in messages.read().decode(errors="replace").splitlines() if line.strip()]
    last = "; ".join(said[-3:])[-500:] or "it said nothing"
    return ResultError(
        f"{path}: ffmpeg {what} ({ending}: {last}); free disk space and memory, or name another ffmpeg with libx264 "
        "in the environment variable IMAGEIO_FFMPEG_EXE"
    )
