"""What `drivesplat check` does and prints, and what the methods of a recording cost on this machine."""

import argparse
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from drivesplat.cli.check.chosen import ChosenScene, chosen_scene, config_of
from drivesplat.cli.check.contents import contents, lacks, outline_of, sweep_columns
from drivesplat.cli.check.fitness import OWN, verdicts
from drivesplat.cli.check.needed_settings import as_yaml, lacking_settings, needed_settings
from drivesplat.cli.check.reading import CheckedScene, read_recording
from drivesplat.errors import DatasetError
from drivesplat.io.this_copy import in_this_copy
from drivesplat.preprocess.intrinsics import intrinsics_warnings
from drivesplat.preprocess.undistort import distortion_fault, undistorted
from drivesplat.readers.by_name import dataset_module, has_module
from drivesplat.readers.check_picture import write_picture
from drivesplat.readers.datasets import layout, unpacker
from drivesplat.readers.drive.format import grouped
from drivesplat.readers.drive_warnings import drive_warnings
from drivesplat.readers.outline import Outline
from drivesplat.readers.record_names import counted
from drivesplat.scene.scene import UNPOSED, Scene
from drivesplat.scene.scene_warnings import luminance, scene_warnings
from drivesplat.settings.config import Config, for_scene
from drivesplat.settings.without_boxes import DISCOVERED, DRIFTING, HOW, REPLACED, reason
from drivesplat.workflow.costs.estimate import Expectations, Machine, PlannedJob, estimate, in_one_line
from drivesplat.workflow.costs.measured import JobId, read_costs
from drivesplat.workflow.gpus import any_gpu, visible_gpus
from drivesplat.workflow.recording_faults import image_gb
from drivesplat.workflow.stages import TRAIN, stages_of_metrics, track_stages, training_inputs

EXAMINE = "drivesplat.readers.*.check"
"""The module of a reader that lists every fault of a recording, where there is more to it than reading it."""
BASE_GB, GB_PER_MILLION = 1.5, 1.2
"""GPU memory of a training of `street` without its images: in all, and for each million Gaussians (docs/measured.md,
presets)."""
BYTES_PER_GAUSSIAN = 400
"""Of a method's checkpoint and exported files, about."""


def run_check(asked: argparse.Namespace) -> int:
    """Checks a recording and prints what it found. Returns the exit status: 1 where there are faults, or no method can
    be trained on it."""
    chosen = chosen_scene(asked.place, asked.scene, asked.version)
    print(chosen.said + (f"; checked: {chosen.name}, --scene names another" if chosen.others else ""))
    with tempfile.TemporaryDirectory(prefix="drivesplat-check-") as folder:
        checked, faults = _examined(chosen, asked.picture, Path(folder))
        if checked is None or faults:
            print(counted(len(faults), "fault"))
            return 1
        for sentence in _warnings(checked):
            print(f"warning: {sentence}")
        return 0 if _print_findings(chosen, checked) else 1


def _examined(chosen: ChosenScene, picture: Path | None, folder: Path) -> tuple[CheckedScene | None, list[str]]:
    """Reads a recording, prints its faults and where its picture is."""
    if has_module(EXAMINE, chosen.reader):
        own = layout(chosen.reader).scene_folder(chosen.root, chosen.name)
        picture = picture or own / "check.png"
        found = dataset_module(EXAMINE, chosen.reader).examine(own, picture)
        scene, faults, no_picture = found.scene, found.faults, found.no_picture
        checked = None if scene is None else CheckedScene(scene, scene, [], [])
        if checked is not None and chosen.frames and not faults:
            checked = read_recording(chosen, folder)
    else:
        picture = picture or Path(f"check-{chosen.name}.png")
        checked, faults = read_recording(chosen, folder), []
        scene = checked.at_hand
        no_picture = write_picture(scene, scene.sweeps, picture)
    faults = faults or [fault for camera in (scene.cameras if scene else ()) if (fault := distortion_fault(camera))]
    for line in grouped(faults):
        print(line)
    if no_picture:
        print(no_picture)
    elif scene is not None:
        print(_about_picture(scene, picture))
    if checked is not None and checked.opened:
        print(f"opened: {checked.opened[0]} images and {checked.opened[1]} sweeps, a sample")
    return checked, faults


def _print_findings(chosen: ChosenScene, checked: CheckedScene) -> bool:
    """Prints what a recording holds and lacks, and what that means. Returns whether a method can be trained on it."""
    scene, columns = checked.whole, sweep_columns(checked.at_hand)
    outline = outline_of(scene, columns)
    needed = needed_settings(chosen, checked, outline, memory_gb())
    settings = {} if chosen.of_config else needed
    config = config_of(chosen, settings)
    judged = list(verdicts(chosen, settings, scene, outline))
    _section("holds", contents(checked, columns))
    _section("lacks", lacks(checked, columns))
    _section("notes", scene_warnings(scene, luminance(checked.at_hand)))
    own = [one.method for one in judged if one.source in OWN]
    _section(f"methods: {', '.join(own)}{'' if scene.tracks else _instead_of_street(own)}", map(str, judged))
    able = [one.method for one in judged if one.source in OWN and one.fault is None]
    if not able:
        print(f"no method can be trained on scene {chosen.name}")
        return False
    _section("costs", expected_costs(chosen, config, able, outline))
    if chosen.of_config:
        lacking = lacking_settings(for_scene(config, chosen.name), needed)
        fit = "settings: those of the config file fit"
        print(f"settings to add:\n\n{as_yaml(lacking)}".rstrip() if lacking else fit)
    else:
        print(f"settings to copy:\n\n{as_yaml(needed)}\n{in_this_copy(_next_step(config, chosen.name))}")
    return True


def _next_step(config: Config, scene: str) -> str:
    """How to go on with the settings to copy."""
    films = " films" if config.cameras else ""
    return (
        f"save them as mine.yaml, then run `snakemake --cores {len(os.sched_getaffinity(0))} --configfile mine.yaml -- "
        f"{config.results_dir}/{scene}/metrics.json{films}`\n"
        "(add `train: {iterations: 300}` for a first try)"
    )


def _instead_of_street(methods: list[str]) -> str:
    """Why a method takes the place of `street` on a drive without boxes, where one does."""
    found = next((name for name in (DISCOVERED, DRIFTING) if name in methods and REPLACED not in methods), None)
    return "" if found is None else f" (the drive has {reason(found)}; {HOW})"


def _section(title: str, lines: Iterable[str]) -> None:
    """Prints lines below a title; nothing without lines."""
    for number, line in enumerate(lines):
        if number == 0:
            print(title if ":" in title else f"{title}:")
        print(f"  {line}")


def _about_picture(scene: Scene, picture: Path) -> str:
    boxes = scene.tracks and scene.poses != UNPOSED
    seen = ["returns must lie on surfaces, also those of other times"] if scene.frames and scene.sweeps else []
    seen += ["boxes around objects" if seen else "boxes must lie around objects"] if boxes else []
    return ": ".join([f"picture: {picture}", *([", and ".join(seen)] if seen else [])])


def _warnings(checked: CheckedScene) -> list[str]:
    """What contradicts each other in a recording."""
    scene = checked.whole
    try:
        from drivesplat.preprocess.poses.lens import lens_warnings, with_tested_images  # imports pycolmap

        with tempfile.TemporaryDirectory(prefix="drivesplat-undistorted-") as folder:
            found = lens_warnings(undistorted(with_tested_images(scene), Path(folder)))
    except ImportError as error:
        found = [f"intrinsics are not compared with images: pycolmap or pyceres cannot be imported ({error})"]
    except DatasetError as error:
        found = [f"intrinsics are not compared with images: {error}"]
    return [*drive_warnings(scene), *intrinsics_warnings(scene), *found]


def memory_gb() -> float:
    """The memory in GB of the device that trains: of the GPU, or else of this machine."""
    if any_gpu():
        with suppress(ImportError, RuntimeError):
            import torch

            if torch.cuda.is_available():
                return torch.cuda.mem_get_info()[1] * 1e-9
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * 1e-9


def expected_costs(chosen: ChosenScene, config: Config, methods: list[str], outline: Outline) -> Iterator[str]:
    """Sentences about the cost of metrics.json for some methods of a config, on this machine."""
    results, on_gpu, name = Path(config.results_dir), any_gpu(), chosen.name
    cores = len(os.sched_getaffinity(0))
    jobs = list(_planned(config, name, methods, on_gpu, max(1, cores // 2)))
    found = estimate(jobs, Expectations(config, read_costs(results)[0]), Machine(cores, visible_gpus()), results)
    iterations = sorted({for_scene(config, name, method).train.iterations for method in methods})
    many = " or ".join(map(str, iterations))
    yield f"metrics of {', '.join(methods)}, with {many} iterations of training: {in_one_line(found)}"
    config.outlines[name] = outline
    size = image_gb(config, name) or 0.0
    gaussians = max(for_scene(config, name, method).train.cap_max for method in methods) * 1e-6
    kind = "GPU memory" if on_gpu else "main memory, without a GPU"
    yield (
        f"a training takes about {BASE_GB + GB_PER_MILLION * gaussians + size:.1f} GB of {kind}, of which its images "
        f"take {size:.1f} GB; images.width and train.cap_max lower it"
    )
    written = _unpacked_bytes(chosen) + len(methods) * gaussians * 1e6 * BYTES_PER_GAUSSIAN
    yield f"results take very roughly {written * 1e-9:.1f} GB at most in {results}/"


def _planned(config: Config, name: str, methods: list[str], on_gpu: bool, threads: int) -> Iterator[PlannedJob]:
    """The jobs behind a scene's metrics.json."""
    of_scene, of_method = stages_of_metrics(config, name)
    more = [s for m in methods for s in (*training_inputs(config, name, m), *track_stages(config, name, m))]
    for stage in dict.fromkeys((*of_scene, *more)):
        yield PlannedJob(JobId(stage, name), 1, False)
    for method in methods:
        for stage in of_method:
            yield PlannedJob(JobId(stage, name, method), threads, on_gpu and stage == TRAIN)


def _unpacked_bytes(chosen: ChosenScene) -> float:
    """Bytes of the images and sweeps that a reader writes as files of their own: those of its recording, about."""
    if unpacker(chosen.reader) is None:
        return 0.0
    files = layout(chosen.reader).table_files(chosen.root, chosen.version, chosen.name)
    folders = {file if file.is_file() and file.suffix != "" else file.parent for file in files}
    every = (file for place in folders for file in ([place] if place.is_file() else place.rglob("*")))
    return float(sum(file.stat().st_size for file in every if file.is_file()))
