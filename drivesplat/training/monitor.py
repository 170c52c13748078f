"""Monitoring of a training: TensorBoard, a progress bar, and an error for values that are NaN or Inf."""

import json
import logging
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams
from tqdm import tqdm

from drivesplat.errors import ResultError, TrainingError
from drivesplat.io.storage import unwritable
from drivesplat.kernels.optimization import NEVER, record_not_finite
from drivesplat.model.picture import Picture
from drivesplat.model.splat_model import SplatModel
from drivesplat.training.views import TrainingView

log = logging.getLogger(__name__)

WATCHED = 65_536
"""Maximum number of values in all combinations that iterations of a training watch."""
LOGGED_EVERY_S = 10.0
PICTURE_HEIGHT = 360
"""Approximate maximum height in pixels of images in TensorBoard."""


def readable(optimizer: str, model: SplatModel) -> str:
    """The name in messages of the parameter of an optimizer of a model (`ModelOptimizers.all`): 'background means',
    'sky texels'."""
    owner, *_, name = optimizer.split(".")
    return f"{model.parts[int(owner)].name if owner.isdigit() else owner} {name}"


def camera_figures(model: SplatModel) -> dict[str, float]:
    """The learned figures of cameras by name: 'exposure/CAM_BACK/gain_red'."""
    figures = {} if model.exposure is None else model.exposure.figures()
    return {f"exposure/{name}": value for name, value in figures.items()}


def flattened(settings: Mapping[str, Any], above: str = "") -> Iterator[tuple[str, float | str]]:
    """Nested settings one by one: a number or text by its name.

    >>> dict(flattened({"mcmc": {"cap": 5}, "sky": None}))
    {'mcmc.cap': 5, 'sky': 'null'}
    """
    for name, value in settings.items():
        if isinstance(value, Mapping):
            yield from flattened(value, f"{above}{name}.")
        else:
            plain = isinstance(value, (int, float, str)) and not isinstance(value, bool)
            yield f"{above}{name}", value if plain else json.dumps(value)


class FiniteGuard:
    """Records on the device the first iteration at which each watched value was not finite.

    The records are slices of memory that exists from the beginning: a CUDA graph that captured their creation would
    reset them at every replay.
    """

    def __init__(self, device: torch.device):
        self._records = torch.full((WATCHED,), NEVER, device=device)
        self._first: dict[tuple[str, ...], Tensor] = {}

    def watch(self, step: int | Tensor, values: dict[str, Tensor]) -> None:
        """Checks the scalars `values`, by name, of an iteration `step`, an int or an int64 scalar on the device.

        Raises ValueError where different iterations watch more than WATCHED values together.
        """
        names = tuple(values)
        if names not in self._first:
            begin = sum(map(len, self._first))
            if begin + len(names) > WATCHED:
                raise ValueError(f"iterations watch more than {WATCHED} values")
            self._first[names] = self._records[begin : begin + len(names)]
        stacked = torch.stack([value.detach() for value in values.values()])
        record_not_finite(stacked, step, self._first[names])

    def check(self, checkpoint: str, tracks: Callable[[], list[str]] = list) -> None:
        """Raises TrainingError naming the earliest iteration and its terms where one was not finite, and the `tracks`
        whose parameters are not finite since."""
        found = [
            (step, name)
            for names, first in self._first.items()
            for step, name in zip(first.tolist(), names, strict=True)
        ]
        step = min((step for step, _ in found), default=NEVER)
        if step < NEVER:
            names = ", ".join(name for at, name in found if at == step)
            if broken := tracks():
                names += f" (tracks {', '.join(broken)})"
            raise TrainingError(
                f"iteration {step + 1}: {names} is not finite; the last good checkpoint is kept ({checkpoint}); "
                "lower the learning rates (train.gaussians.lr_*) or raise train.mcmc.min_opacity"
            )


class Monitor:
    """Writes scalars and images into a TensorBoard folder, progress and remaining time into the log, and a progress bar
    to a terminal. Raises ResultError, naming the folder, where it cannot be written."""

    def __init__(self, folder: Path, iterations: int, start: int, label: str):
        self._folder = folder
        self._iterations = iterations
        self._logged: tuple[int, float] | None = None
        with self._writing():
            self._writer = SummaryWriter(str(folder), purge_step=start + 1 if start else None)
        self._bar = tqdm(
            total=iterations, initial=start, desc=label, unit="it", disable=not sys.stderr.isatty(), mininterval=1.0
        )

    def hyperparameters(self, settings: Mapping[str, Any], results: Iterable[str]) -> None:
        """Writes nested settings for TensorBoard's table of trainings, beside the last values of the scalars
        `results`."""
        with self._writing():
            for summary in hparams(dict(flattened(settings)), dict.fromkeys(results)):
                self._writer.file_writer.add_summary(summary)

    def scalars(self, step: int, values: dict[str, float], advanced: int) -> None:
        self.write(step, values)
        self._bar.update(advanced)
        self._bar.set_postfix(loss=f"{values['loss/total']:.4f}", gaussians=f"{values['gaussians']:,.0f}")

    def write(self, step: int, values: dict[str, float]) -> None:
        with self._writing():
            for name, value in values.items():
                self._writer.add_scalar(name, value, step)

    def progress(self, step: int, terms: Mapping[str, Tensor]) -> None:
        """Logs 'iteration 430 of 1000, loss 0.0512, 12.3 it/s, 46 s left' every LOGGED_EVERY_S, by the speed since the
        last message, and the first iteration of a run, which compiles kernels, without a speed. Only then the host
        waits for the loss `terms`. `drivesplat.workflow.costs.progress` reads it."""
        now = time.monotonic()
        before, logged = self._logged or (step, now)
        if self._logged and now - logged < LOGGED_EVERY_S:
            return
        speed = (step - before) / (now - logged) if self._logged else 0.0
        rest = f", {speed:.3g} it/s, {(self._iterations - step) / speed:.0f} s left" if speed else ""
        log.info("iteration %d of %d, loss %.4g%s", step, self._iterations, sum(map(float, terms.values())), rest)
        self._logged = step, time.monotonic()

    def image(self, step: int, view: TrainingView, picture: Picture) -> None:
        """Writes the recorded and the rendered image side by side, reduced for fast encoding."""
        pair = torch.cat([view.target(), picture.image.detach().clamp(0.0, 1.0)], dim=1).permute(2, 0, 1)
        pair = F.avg_pool2d(pair, max(1, round(pair.shape[1] / PICTURE_HEIGHT)))
        with self._writing():
            self._writer.add_image("recorded_and_rendered", pair.cpu(), step)

    def close(self) -> None:
        self._bar.close()
        with self._writing():
            self._writer.close()

    def __enter__(self) -> "Monitor":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Closes the monitor; an error of the training takes precedence over one of the disk."""
        with suppress(ResultError) if kind else nullcontext():
            self.close()

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise unwritable(self._folder, error) from error
