"""The stages `export_spz` and `export_sog`: splat.ply as smaller files, by the formats' own programs.

SPZ (Niantic, https://github.com/nianticlabs/spz) version 3, by gsply: positions in 24 bits, everything else in 8 to 10
bits. SOG (PlayCanvas, https://developer.playcanvas.com), by @playcanvas/splat-transform.
"""

import logging
import math
import shutil
import subprocess
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.io.storage import atomic_path

log = logging.getLogger(__name__)

SPZ_VERSION = 3
MAX_FRACTIONAL_BITS = 12
"""Positions to a quarter of a millimetre, which reach 2 km from the origin; fewer bits where a scene is larger."""
SOG_PROGRAM = "splat-transform"


def export_spz(path: str | Path, splat: str | Path) -> None:
    """Writes the Gaussians of `splat` as SPZ. Raises DriveSplatError without gsply, ResultError where a file cannot be
    read or written."""
    try:
        from gsply import GSData
        from gsply.spz import write_spz
    except ImportError as error:
        raise DriveSplatError(
            "splat.spz needs gsply, which is not installed: run 'make setup', or drop spz from export.formats"
        ) from error
    # torch takes 1 s, which `export_sog` does without
    import torch

    from drivesplat.model.splat_ply import ALMOST_ONE, TINY, read_splat_ply

    gaussians = read_splat_ply(splat, "export")
    data = GSData(
        means=gaussians.means.numpy(),
        scales=torch.log(gaussians.scales).numpy(),
        quats=gaussians.quats.numpy(),
        opacities=torch.logit(gaussians.opacities.double().clamp(TINY, ALMOST_ONE)).float().numpy(),
        sh0=gaussians.sh0[:, 0].numpy(),
        shN=gaussians.shN.numpy(),
    )
    bits = fractional_bits(float(gaussians.means.abs().max()) if len(gaussians) else 0.0)
    with atomic_path(path) as aside:
        write_spz(aside, data, version=SPZ_VERSION, fractional_bits=bits)


def fractional_bits(largest: float) -> int:
    """The bits after the point with which coordinates up to `largest` metres fit into 24 bits with a sign."""
    return max(1, min(MAX_FRACTIONAL_BITS, 22 - math.floor(math.log2(max(largest, 1.0)))))


def export_sog(path: str | Path, splat: str | Path) -> None:
    """Writes the Gaussians of `splat` as SOG. Raises DriveSplatError without splat-transform or where it fails."""
    program = shutil.which(SOG_PROGRAM)
    if program is None:
        raise DriveSplatError(
            "splat.sog needs Node and splat-transform, which is not on the PATH: run "
            "'npm install --global @playcanvas/splat-transform', or drop sog from export.formats"
        )
    with atomic_path(path) as aside:
        command = [program, "--overwrite", "--gpu", "cpu", str(splat), str(aside)]
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=False)
        log.info("%s", done.stdout)
        if done.returncode or not aside.is_file():
            last = (done.stdout.strip().splitlines() or ["no output"])[-1]
            raise DriveSplatError(f"{path}: {SOG_PROGRAM} failed with status {done.returncode} ({last.strip()})")
