"""The plain recipe's training: the loop of gsplat's example trainer, with its logging and checkpoints."""

import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from gsplat import rasterization
from jaxtyping import Bool
from torch import Tensor
from torch.utils.data import Dataset
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm

from benchmarks.speed.plain import (
    DECAY,
    LOGGED_EVERY,
    OPACITY_REG,
    SAVED_AT,
    SCALE_REG,
    SSIM_WEIGHT,
    Optimizers,
    PlainRecipe,
    Splats,
    as_model,
    make_optimizers,
)
from benchmarks.speed.plain_images import endless, loader_of
from benchmarks.speed.plain_ssim import Ssim, chosen_ssim
from drivesplat.io.checkpoint_file import save
from drivesplat.kernels.gsplat_private import cpu_strategies
from drivesplat.model.sky import CubemapSky
from drivesplat.model.view import View
from drivesplat.rasterization import rasterize
from drivesplat.training.probes import NO_PROBES, Probes
from drivesplat.training.step import ITERATION, UNTIMED, Clock

CHECKPOINT = "ckpt.npz"


@dataclass(frozen=True)
class PlainSummary:
    """The outcome of a training: the seconds of its loop, the time when its files were complete (`time.monotonic`), the
    number of Gaussians, torch's peak memory (GB; None on the CPU), and the name of its SSIM."""

    seconds: float
    ended: float
    gaussians: int
    peak_gpu_memory_gb: float | None
    ssim: str


def fit(
    splats: Splats,
    images: Dataset,
    scale: float,
    recipe: PlainRecipe,
    folder: Path,
    clock: Clock = UNTIMED,
    sky: CubemapSky | None = None,
    visits: Probes = NO_PROBES,
) -> PlainSummary:
    """Fits Gaussians, and the `sky` behind them, to `images` on their device; `scale` is the scene's. Scalars and
    checkpoints go to `folder`. `clock` times the stages of an iteration; `visits` see the model during the training."""
    device = splats["means"].device
    on_gpu = device.type == "cuda"
    torch.manual_seed(recipe.seed)
    if on_gpu:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    optimizers = make_optimizers(splats, scale, recipe.variant)
    training = PlainTraining(splats, optimizers, recipe, device, chosen_ssim(device), clock, sky)
    data = endless(loader_of(images, recipe.workers, device))
    with SummaryWriter(str(folder / "tensorboard")) as writer:
        seconds = training.run(data, writer, folder, scale, visits)
    save(folder / CHECKPOINT, training.state())
    ended = time.monotonic()  # without the seconds that the decoding processes take to exit
    peak = torch.cuda.max_memory_reserved(device) / 1e9 if on_gpu else None
    return PlainSummary(seconds, ended, len(splats["means"]), peak, training.ssim.name)


class PlainTraining:
    """A training by the plain recipe between two iterations."""

    def __init__(
        self,
        splats: Splats,
        optimizers: Optimizers,
        recipe: PlainRecipe,
        device: torch.device,
        ssim: Ssim,
        clock: Clock = UNTIMED,
        sky: CubemapSky | None = None,
    ):
        self.splats, self.optimizers, self.recipe, self.device = splats, optimizers, recipe, device
        self.ssim, self.clock, self.sky, self.step = ssim, clock, sky, 0
        self._beside = [] if sky is None else [adam_of(sky)]
        self._strategy = recipe.strategy()
        self._strategy.check_sanity(splats, optimizers)
        self._strategy_state = self._strategy.initialize_state()
        decay = DECAY ** (1.0 / recipe.schedule.iterations)
        self._schedule = torch.optim.lr_scheduler.ExponentialLR(optimizers["means"], gamma=decay)

    def run(
        self,
        data: Iterator[dict[str, Tensor]],
        writer: SummaryWriter,
        folder: Path,
        extent: float,
        visits: Probes = NO_PROBES,
    ) -> float:
        """All iterations. Returns their seconds, without those of visits, which see Gaussians of this `extent`."""
        began = time.monotonic()
        bar = tqdm(range(self.recipe.schedule.iterations), desc="plain", disable=not sys.stderr.isatty())
        for _ in bar:
            with self.clock.stage(ITERATION):
                terms, info = self.training_step(data)
                bar.set_description(f"loss={terms['loss'].item():.3f}")
                if self.step % LOGGED_EVERY == 0:
                    self._log(terms, writer)
                if self.step + 1 in SAVED_AT:
                    save(folder / CHECKPOINT, self.state())
                self.learn(info)
            if visits.due(self.step, self.recipe.schedule.iterations):
                self._finish()
                seconds, model = time.monotonic() - began, as_model(self.state()["splats"], extent, self.sky)
                began += visits.stop(self.step, seconds, model)
        self._finish()
        return time.monotonic() - began

    def _finish(self) -> None:
        """Waits until the GPU has done what was launched."""
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def training_step(self, data: Iterator[dict[str, Tensor]]) -> tuple[dict[str, Tensor], dict[str, Any]]:
        """The first half of an iteration: renders the next image and computes gradients. Returns the terms of the loss,
        and the rasterizer's output for densification."""
        with self.clock.stage("data"):
            batch = next(data)
            camtoworlds, intrinsics = batch["camtoworld"].to(self.device), batch["K"].to(self.device)
            pixels = batch["image"].to(self.device) / 255.0
        with self.clock.stage("render"):
            colors, info = self._render(camtoworlds, intrinsics, pixels.shape[2], pixels.shape[1])
        with self.clock.stage("loss"):
            terms = self._loss(colors, pixels)
        with self.clock.stage("backward"):
            terms["loss"].backward()
        return terms, info

    def learn(self, info: dict[str, Any]) -> None:
        """The second half: optimizer steps and densification."""
        with self.clock.stage("optimizer"):
            visible = (_visible(info, len(self.splats["means"])),) if self.recipe.variant.packed else ()
            for optimizer in self.optimizers.values():
                optimizer.step(*visible)
                optimizer.zero_grad(set_to_none=True)
            for optimizer in self._beside:
                optimizer.step()
                optimizer.zero_grad(set_to_none=True)
            self._schedule.step()
        with self.clock.stage("densification"), self._kernels():
            rate = self._schedule.get_last_lr()[0]
            self._strategy.step_post_backward(
                self.splats, self.optimizers, self._strategy_state, self.step, info, lr=rate
            )
        self.step += 1

    def state(self) -> dict[str, Any]:
        """The content of a checkpoint."""
        splats = {name: value.detach() for name, value in self.splats.items()}
        sky = {} if self.sky is None else {"sky": self.sky.state_dict()}
        return {"step": self.step, "splats": splats, **sky}

    def _render(self, camtoworlds: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, dict[str, Any]]:
        """The image (1, h, w, 3) before the sky or black, and the rasterizer's output for densification."""
        gaussians = (
            self.splats["means"],
            self.splats["quats"],
            torch.exp(self.splats["scales"]),
            torch.sigmoid(self.splats["opacities"]),
            torch.cat([self.splats["sh0"], self.splats["shN"]], dim=1),
        )
        cameras, degree = (torch.linalg.inv(camtoworlds), Ks, width, height), self.recipe.schedule.sh_degree(self.step)
        if self.device.type == "cuda":
            packed = self.recipe.variant.packed
            colors, alphas, info = rasterization(*gaussians, *cameras, sh_degree=degree, packed=packed)
        else:
            rendering = rasterize(*gaussians, *cameras, sh_degree=degree)
            colors, alphas, info = rendering.image, rendering.alpha, rendering.info
        if self.sky is not None:
            view = View(Ks[0], camtoworlds[0], width, height, time=0.0)
            colors = self.sky.behind(colors[0], alphas[0], view)[None]
        return colors, info

    def _loss(self, colors: Tensor, pixels: Tensor) -> dict[str, Tensor]:
        l1 = F.l1_loss(colors, pixels)
        ssim = 1.0 - self.ssim.of(colors.permute(0, 3, 1, 2), pixels.permute(0, 3, 1, 2))
        loss = l1 * (1.0 - SSIM_WEIGHT) + ssim * SSIM_WEIGHT
        loss = loss + OPACITY_REG * torch.sigmoid(self.splats["opacities"]).mean()
        loss = loss + SCALE_REG * torch.exp(self.splats["scales"]).mean()
        return {"loss": loss, "l1loss": l1, "ssimloss": ssim}

    def _log(self, terms: dict[str, Tensor], writer: SummaryWriter) -> None:
        for name, value in terms.items():
            writer.add_scalar(f"train/{name}", value.item(), self.step)
        writer.add_scalar("train/num_GS", len(self.splats["means"]), self.step)
        if self.device.type == "cuda":
            writer.add_scalar("train/mem", torch.cuda.max_memory_allocated() / 1024**3, self.step)
        writer.flush()

    def _kernels(self) -> AbstractContextManager[None]:
        """On a CPU, replaces the two CUDA kernels that gsplat's strategies call by torch functions."""
        return nullcontext() if self.device.type == "cuda" else cpu_strategies()


def adam_of(sky: CubemapSky) -> torch.optim.Optimizer:
    """The Adam of a sky, with its own learning rate."""
    (rate,) = sky.learning_rates().values()
    return torch.optim.Adam(sky.parameters(), lr=rate, eps=1e-15, fused=True)


def _visible(info: dict[str, Any], count: int) -> Bool[Tensor, " n"]:
    """The mask of the Gaussians that a packed rasterization listed."""
    ids = info["gaussian_ids"]
    return torch.zeros(count, dtype=torch.bool, device=ids.device).scatter_(0, ids.long(), True)
