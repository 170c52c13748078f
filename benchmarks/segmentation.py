"""The effect of maps by a network: true maps of synthetic worlds in place of a network's, against the heuristic.

    python -m benchmarks.segmentation --out results/segmentation -- --cores 16
    python -m benchmarks.segmentation --out results/tiny --worlds 1 --width 160 --iterations 200 -- --cores 2

Makes the worlds, trains `street` on each, once with the sky by the heuristic and once for each variant with maps that
went through the stage `segment`, and writes segmentation.json and segmentation.md. Arguments after -- are Snakemake's.

- heuristic: the default; no class maps
- sky: true sky masks
- maps: true sky masks and class maps
- coarse: the same at an eighth of the resolution, as borders by a network are

A comparison with the heuristic says what a network can win at most, and with `coarse` what its borders cost. Figures:
intersection over union of the sky mask with the true sky of all images, the share of wrong pixels, and PSNR on held-out
images of static pixels, of moving vehicles, and of all pixels from 2 m beside the path.
"""

import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from jaxtyping import UInt8

from benchmarks.command import (
    argument_parser,
    print_page,
    require_workflow,
    run_command,
    split_arguments,
    write_record,
)  # fmt: skip
from drivesplat.errors import ConfigError, DriveSplatError
from drivesplat.io.storage import atomic_write, read_json
from drivesplat.preprocess.segmentation.label_sets import CLASSES, SKY, LabelSet
from drivesplat.preprocess.segmentation.maps import make_maps
from drivesplat.preprocess.segmentation.network import Network
from drivesplat.scene.images import read_image, read_mask
from drivesplat.scene.masks import UNLABELLED, read_sky_mask
from drivesplat.scene.scene import read_scene
from drivesplat.settings.segment import SegmentJob
from drivesplat.world.shapes.mesh import SurfaceClass

NAME = "segmentation"
HEURISTIC = "heuristic"
VARIANTS: dict[str, tuple[str, ...]] = {
    HEURISTIC: (), "sky": ("sky",), "maps": ("sky", "semantic"), "coarse": ("sky", "semantic"),
}  # fmt: skip
"""The maps that each variant uses."""
COARSE = 8
RECORDED: dict[str, Any] = {"key_frames": 40, "key_frame_hz": 10, "image_hz": 10, "lidar_hz": 10, "sweeps": []}
WORLDS: dict[str, dict[str, Any]] = {
    "day": {"random_seed": 21, "vehicles": 3, "pedestrians": 8, "bystanders": 2, "cyclists": 1},
    "queue": {"random_seed": 22, "traffic": "queue", "pedestrians": 6, "parked": 14},
    "slope": {"random_seed": 23, "vehicles": 2, "pedestrians": 12, "bend_deg": 30.0, "grade": 0.05},
    "night": {"random_seed": 24, "vehicles": 3, "pedestrians": 6, "night": True, "wet": True},
    "wet": {"random_seed": 25, "vehicles": 2, "pedestrians": 8, "wet": True, "bend_deg": -25.0},
}
OF_WORLDS = {
    "ROAD": "road", "MARKING": "road", "SIDEWALK": "sidewalk", "TERRAIN": "terrain", "BUILDING": "building",
    "FENCE": "fence", "VEGETATION": "vegetation", "POLE": "pole", "SIGN": "traffic sign", "VEHICLE": "car",
    "PERSON": "person", "CYCLIST": "rider", "SKY": "sky",
}  # fmt: skip
"""The classes of maps by network of those of worlds; animals and other objects have none."""
FIGURES = {
    "sky_iou": "sky IoU", "sky_error": "wrong sky pixels", "static_psnr": "static", "moving_psnr": "moving vehicles",
    "beside_psnr": "2 m aside", "train_seconds": "training (s)",
}  # fmt: skip


class TrueMaps(Network):
    """A stub for a network: it knows the images of a synthetic world with class maps, and gives their true classes, at
    1/`coarse` of the resolution."""

    def __init__(self, world: Path, coarse: int = 1):
        of_labels = np.array([*range(len(CLASSES)), UNLABELLED], dtype=np.uint8)  # the last: of none of the classes
        super().__init__(LabelSet("own", of_labels), f"true {world} {coarse}", 8)
        self._coarse = coarse
        self._table = np.full(256, len(CLASSES), dtype=np.uint8)
        for name, other in OF_WORLDS.items():
            self._table[SurfaceClass[name]] = CLASSES.index(other)
        self._maps = {_key(read_image(image)): _true_files(world, image) for image in _images(world)}

    def segment(self, images: UInt8[np.ndarray, "n h w 3"], size: tuple[int, int]) -> UInt8[np.ndarray, "n v u"]:
        small = (max(1, size[0] // self._coarse), max(1, size[1] // self._coarse))
        found = []
        for image in images:
            classes, sky = (read_mask(path, small) for path in self._maps[_key(image)])
            true = np.where(sky > 127, np.uint8(SKY), self._table[classes])
            found.append(cv2.resize(true, size, interpolation=cv2.INTER_NEAREST))
        return np.stack(found)


def _key(pixels: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(pixels).tobytes()).hexdigest()


def _images(world: Path) -> list[Path]:
    """The images of a world that have class maps."""
    found = [path for folder in ("samples", "sweeps") for path in world.glob(f"{folder}/CAM_*/*.jpg")]
    return [path for path in found if _true_files(world, path)[0].is_file()]


def _true_files(world: Path, image: Path) -> tuple[Path, Path]:
    """The class map and the sky mask of an image."""
    classes, sky = (world / kind / image.parent.name / f"{image.stem}.png" for kind in ("semantic", "sky"))
    return classes, sky


def settings(
    out: Path, variant: str, names: Sequence[str], width: int, iterations: int, maps: Mapping[str, Path]
) -> dict[str, Any]:
    """The config of a variant, to lay over config.yaml. `maps`: the folder of the maps of each world."""
    datasets: dict[str, Any] = {"nuscenes": {"batch": False}}
    for name in names:
        folders = {f"{kind}_folder": str(maps[name] / kind) for kind in VARIANTS[variant]}
        world = {**RECORDED, **WORLDS[name], "width": width, "class_maps": True, "truth": {"lateral_m": [2.0, -2.0]}}
        datasets[name] = {
            "dataroot": str(out / "worlds" / name),
            "scenes": [name],
            "overrides": {"masks": folders},
            "world": world,
        }
    return {
        "datasets": datasets,
        "methods": {"vanilla": None},
        "train": {"iterations": iterations},
        "lpips": {"enabled": False},
        "device": {"kind": "any", "min_free_gb": 2.0, "jobs_per_card": len(names)},
        "results_dir": str(out / variant),
    }


def run(config: dict[str, Any], out: Path, variant: str, names: Sequence[str], arguments: Sequence[str]) -> None:
    """Makes the metrics.json of all worlds of a variant. Raises DriveSplatError where Snakemake fails."""
    file = out / f"{variant}.yaml"
    with atomic_write(file) as opened:
        opened.write(yaml.safe_dump(config, sort_keys=False).encode())
    targets = [f"{config['results_dir']}/{name}/metrics.json" for name in names]
    given = list(arguments) or ["--cores", str(os.cpu_count())]
    command = [sys.executable, "-m", "snakemake", "--configfile", str(file), "--resources", f"gpu={len(names)}", *given]
    if subprocess.run([*command, "--", *targets]).returncode:
        raise DriveSplatError(f"the variant {variant} failed; see the messages above, and {config['results_dir']}/logs")


def maps_of(out: Path, variant: str, names: Sequence[str]) -> dict[str, Path]:
    """The folders of the true maps of all worlds, made through the stage `segment`."""
    made = {}
    for name in names:
        scene = read_scene(out / HEURISTIC / name / "scene.json")
        job = SegmentJob.model_validate({"model": f"true/{variant}", "labels": None, "height": None, "images": {}})
        network = TrueMaps(out / "worlds" / name, COARSE if variant == "coarse" else 1)
        folder = out / "maps" / variant / name
        make_maps(scene, job, network, folder, out / "maps" / "cache")
        made[name] = folder / job.folder
    return made


def figures(out: Path, variant: str, name: str) -> dict[str, float | None]:
    """The figures of a variant on a world."""
    results, world = out / variant / name, out / "worlds" / name
    both = either = wrong = pixels = 0
    for frame in read_scene(results / "scene.json").frames:
        size = (frame.width, frame.height)
        true = read_mask(_true_files(world, Path(frame.image_path))[1], size) > 127
        found = read_sky_mask(results / "masks", frame.camera, frame.timestamp, size)
        both, either = both + int((true & found).sum()), either + int((true | found).sum())
        wrong, pixels = wrong + int((true ^ found).sum()), pixels + true.size
    method = read_json(results / "metrics.json", "scene_metrics")["methods"]["street"]
    between, beside = method["interpolation"], [method["lateral"][left]["all"]["psnr"] for left in ("2.0", "-2.0")]
    return {
        "sky_iou": both / max(1, either),
        "sky_error": wrong / pixels,
        "static_psnr": between["static"]["psnr"],
        "moving_psnr": between["moving_vehicle"]["psnr"],
        "beside_psnr": float(np.mean(beside)),
        "train_seconds": method["train_seconds"],
    }


def page_of(found: Mapping[str, Mapping[str, Mapping[str, float | None]]], seconds: float) -> str:
    """The table of all worlds, of their means, and of the differences from the heuristic."""
    lines = [f"| world | variant | {' | '.join(FIGURES.values())} |", f"|{'---|' * (len(FIGURES) + 2)}"]
    for name, variants in found.items():
        lines += [f"| {name} | {variant} | {_cells(values)} |" for variant, values in variants.items()]
    first = next(iter(found.values()))
    means = {variant: _mean([variants[variant] for variants in found.values()]) for variant in first}
    lines += [f"| mean | {variant} | {_cells(values)} |" for variant, values in means.items()]
    for variant in (other for other in first if other != HEURISTIC):
        gains = [_difference(variants[variant], variants[HEURISTIC]) for variants in found.values()]
        worst = {key: min((one[key] for one in gains if one[key] is not None), default=None) for key in FIGURES}
        lines += [f"| mean difference | {variant} | {_cells(_mean(gains))} |"]
        lines += [f"| lowest difference | {variant} | {_cells(worst)} |"]
    return "\n".join([*lines, "", f"All of it took {seconds:.0f} s."])


def _difference(one: Mapping[str, float | None], other: Mapping[str, float | None]) -> dict[str, float | None]:
    return {key: None if (a := one[key]) is None or (b := other[key]) is None else a - b for key in FIGURES}


def _mean(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    known = {key: [value for row in rows if (value := row[key]) is not None] for key in FIGURES}
    return {key: float(np.mean(values)) if values else None for key, values in known.items()}


def _cells(values: Mapping[str, float | None]) -> str:
    digits = {"sky_iou": 4, "sky_error": 4, "train_seconds": 1}
    return " | ".join("" if (value := values[key]) is None else f"{value:.{digits.get(key, 2)}f}" for key in FIGURES)


def main(arguments: Sequence[str]) -> int:
    """Writes segmentation.json and segmentation.md."""
    own, of_snakemake = split_arguments(arguments)
    parser = argument_parser(NAME, __doc__)
    parser.add_argument("--out", type=Path, required=True, help="a folder for worlds, results and figures")
    parser.add_argument("--worlds", type=int, default=len(WORLDS), choices=range(1, len(WORLDS) + 1), metavar="N")
    parser.add_argument("--width", type=int, default=640, help="of images in pixels (640)")
    parser.add_argument("--iterations", type=int, default=3000, help="of each training (3000)")
    parser.add_argument("--variants", default="sky,maps,coarse", help="beside the heuristic (sky,maps,coarse)")
    given = parser.parse_args(own)
    require_workflow(Path())
    chosen = [HEURISTIC, *(name for name in given.variants.split(",") if name and name != HEURISTIC)]
    if unknown := [name for name in chosen if name not in VARIANTS]:
        raise ConfigError(f"--variants: there is no {unknown[0]}; there are: {', '.join(VARIANTS)}")
    out, names, start = given.out.absolute(), list(WORLDS)[: given.worlds], time.perf_counter()
    for variant in chosen:
        maps = maps_of(out, variant, names) if VARIANTS[variant] else {}
        run(settings(out, variant, names, given.width, given.iterations, maps), out, variant, names, of_snakemake)
    seconds = time.perf_counter() - start
    found = {name: {variant: figures(out, variant, name) for variant in chosen} for name in names}
    record = {"width": given.width, "iterations": given.iterations, "seconds": seconds, "worlds": found}
    page = page_of(found, seconds)
    write_record(record, page, out, NAME)
    print_page(page, out, NAME)
    return 0


if __name__ == "__main__":
    run_command(main)
