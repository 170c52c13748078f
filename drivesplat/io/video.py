"""H.264 films: encoded by ffmpeg, then decoded by OpenCV to verify them.

The executable is imageio-ffmpeg's, or that in the environment variable IMAGEIO_FFMPEG_EXE.
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

PRESET = "veryfast"
"""Of x264. Its own choice, `medium`, takes 2.5 times the processor time for files of the same size, whose PSNR is 1 dB
higher at 40 dB."""
PATIENCE = 600.0
"""Timeout in seconds for ffmpeg to accept one frame, or to finish a film."""


@dataclass(frozen=True)
class Footage:
    """Properties of a film: number of frames, their width and height in pixels, and frames per second."""

    frames: int
    width: int
    height: int
    fps: float

    def __str__(self) -> str:
        return f"{self.frames} frames of {self.width}x{self.height} at {self.fps:g} fps"


def write_video(
    path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], fps: int | float, crf: int, threads: int = 0
) -> None:
    """Writes `frames` (h, w, 3) uint8 RGB, consumed one at a time, to an MP4 file. `size` is width and height, both
    even; `threads` is the number of encoder threads, 0 for ffmpeg's default.

    Raises ResultError, and leaves no file, where ffmpeg is missing or fails, or the film differs from `frames` in
    number, size or rate. Raises ValueError for a frame of another shape or type.
    """
    with atomic_path(path) as aside:
        try:
            executable = imageio_ffmpeg.get_ffmpeg_exe()
        except RuntimeError as error:
            raise _not_started(path, error) from error
        source = ffmpeg.input("pipe:", format="rawvideo", pix_fmt="rgb24", s=f"{size[0]}x{size[1]}", framerate=fps)
        # By default ffmpeg converts RGB to YUV by the BT.601 matrix, but players convert back by BT.709: colours shift.
        # New versions tag a film by its frames (setparams), old ones by the output options.
        bt709 = {"colorspace": "bt709", "color_primaries": "bt709", "color_trc": "bt709"}
        converted = (
            source.filter(
                "scale", out_color_matrix="bt709", out_range="tv", flags="bicubic+accurate_rnd+full_chroma_int"
            )
            .filter("format", "yuv420p")
            .filter("setparams", range="tv", **bt709)
        )
        film = converted.output(
            f"file:{aside}",
            format="mp4",
            vcodec="libx264",
            preset=PRESET,
            crf=crf,
            movflags="+faststart",
            threads=threads,
            color_range="tv",
            **bt709,
        ).global_args("-hide_banner", "-nostdin", "-nostats", "-loglevel", "error")
        count = _encode(path, frames, size, ffmpeg.compile(film, cmd=executable, overwrite_output=True))
        expected, found = Footage(count, *size, float(fps)), read_footage(aside)
        if found != expected:
            raise ResultError(f"{path}: ffmpeg was given {expected} and wrote {found}; free disk space and rerun")


def read_footage(path: Path) -> Footage:
    """A film's properties according to OpenCV, which decodes every frame; all zero where the file is not a film."""
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


def _encode(path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], command: list[str]) -> int:
    """Encodes all frames and returns their number. In any case the ffmpeg process has ended afterwards."""
    count = 0
    # messages go to a file: a pipe that nobody reads fills up and blocks ffmpeg
    with TemporaryFile() as messages, _running(path, command, messages) as process:
        for frame in frames:
            if frame.shape != (size[1], size[0], 3) or frame.dtype != np.uint8:
                raise ValueError(f"a frame of {frame.shape} {frame.dtype} in a film of {size[0]}x{size[1]}")
            # ffmpeg does not read the frame if it ended, closed its input or exceeds PATIENCE
            watchdog = Timer(PATIENCE, process.kill)
            watchdog.start()
            try:
                process.stdin.write(np.ascontiguousarray(frame).data)
                process.stdin.flush()
            except BrokenPipeError:
                watchdog.cancel()  # not for the process that ends now
                _wait(process, min(10.0, PATIENCE))
                raise _failed(path, f"took no more than {count} frames", process, messages) from None
            finally:
                watchdog.cancel()
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


def _wait(process: subprocess.Popen, seconds: float) -> None:
    with suppress(subprocess.TimeoutExpired):
        process.wait(seconds)


def _not_started(path: Path, error: Exception) -> ResultError:
    return ResultError(
        f"{path}: ffmpeg, which writes it, cannot be started ({error}); "
        "run `make setup`, or name an ffmpeg with libx264 in the environment variable IMAGEIO_FFMPEG_EXE"
    )


def _failed(path: Path, what: str, process: subprocess.Popen, messages: BinaryIO) -> ResultError:
    """An error with `what` happened to ffmpeg, its exit status, and its last output."""
    status = process.poll()
    ending = "still running" if status is None else f"exit status {status}"
    if status is not None and status < 0:
        ending = f"ended by {signal.Signals(-status).name}"
    messages.seek(0)
    lines = [line.strip() for line in messages.read().decode(errors="replace").splitlines() if line.strip()]
    last = "; ".join(lines[-3:])[-500:] or "it said nothing"
    return ResultError(
        f"{path}: ffmpeg {what} ({ending}: {last}); free disk space and memory, or name another ffmpeg with libx264 "
        "in the environment variable IMAGEIO_FFMPEG_EXE"
    )
