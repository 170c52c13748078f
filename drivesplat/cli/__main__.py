"""The console script `drivesplat`.

    drivesplat run --cores 4 -- metrics

Each command imports what it needs: `--help` is fast.
"""

import argparse
import os
import signal
import subprocess
import sys
import webbrowser
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

import drivesplat
from drivesplat import SNAKEFILE, WORKFLOW
from drivesplat.cli import assets, check, estimate, imports, segment, serve, setup
from drivesplat.errors import DriveSplatError
from drivesplat.io.standard_output import standard_output
from drivesplat.io.this_copy import default_config, in_this_copy, of_the_workflow

if TYPE_CHECKING:
    from drivesplat.settings.config import Config

RUN = "run"
BROUGHT_ALONG = ("presets/", "profiles/")
PAGE, OF_MOVING_OBJECTS = "viewer.html", "parts.mp4"


def main(arguments: Sequence[str] | None = None, program: str = "drivesplat") -> int:
    """Runs a command of the command line, whose help calls it `program`. Returns the exit status."""
    given = sys.argv[1:] if arguments is None else list(arguments)
    try:
        try:
            Path.cwd()
        except FileNotFoundError:
            raise DriveSplatError("the current folder has been removed; change to another one") from None
        if given[:1] == [RUN]:  # all the rest is Snakemake's
            return run_workflow(given[1:])
        parsed = _parser(program).parse_args(assets.with_action(given))
        with standard_output():
            return run_command(parsed)
        return 0  # nobody reads the rest
    except DriveSplatError as error:
        print(f"drivesplat: {in_this_copy(str(error))}", file=sys.stderr)
        return 1


def _parser(program: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(program, description="Recorded drives as 3D Gaussian splats, measured.")
    parser.add_argument("--version", action="version", version=f"drivesplat {_version()}")
    commands = parser.add_subparsers(required=True, dest="command", metavar="COMMAND")

    text = "run the workflow: all arguments are Snakemake's, as in drivesplat run --cores 4 -- metrics"
    commands.add_parser(RUN, help=text)

    demo = commands.add_parser("demo", help="run the whole workflow on a synthetic drive, in the current folder")
    demo.add_argument("--cores", default="all", help="number of processors to use (all)")

    show = commands.add_parser("show", help="print the figures of a measured scene as a table and in sentences")
    show.add_argument("scene", type=Path, help="folder of its results, such as results/demo")

    viewer = commands.add_parser("open", help="open a scene's viewer.html in the browser")
    viewer.add_argument("scene", nargs="?", help="by default the scene exported last")
    viewer.add_argument("method", nargs="?", help="by default one with moving objects")
    viewer.add_argument("--results", type=Path, help="folder of the results (results_dir of config.yaml)")

    render = commands.add_parser("render", help="render a trained drive from the poses of a file (docs/python.md)")
    render.add_argument("folder", type=Path, help="of the method, such as results/demo/street")
    render.add_argument("--poses", type=Path, required=True, help=".csv, .json (nerfstudio) or TUM's text format")
    render.add_argument("--camera", help="a recorded camera; by default the one that looks ahead the most")
    render.add_argument("--ego", action="store_true", help="the poses are those of the vehicle, not of the camera")
    render.add_argument("--outputs", default="rgb", help="rgb,depth,instance (rgb)")
    render.add_argument("--out", type=Path, required=True, help="folder to write images into")
    render.add_argument("--film", type=Path, help="also write a film of the images rgb, such as out.mp4")
    render.add_argument("--device", default="any", choices=["any", "cuda", "cpu"], help="any: a GPU where there is one")

    live = commands.add_parser(
        "view", help="look around in a trained drive and edit it, in the browser (docs/live_viewer.md)"
    )
    live.add_argument("folders", type=Path, nargs="+", help="of methods of one scene, such as results/demo/street")
    live.add_argument(
        "--edits", type=Path, default=Path("my_edits.yaml"), help="file to write edits into (my_edits.yaml)"
    )
    live.add_argument("--host", default="127.0.0.1", help="address to listen at; by default this machine alone")
    live.add_argument("--port", type=int, default=8080, help="port to listen at (8080)")
    live.add_argument("--device", default="any", choices=["any", "cuda", "cpu"], help="any: a GPU where there is one")

    serve.add_parser(commands)
    assets.add_parser(commands)
    imports.add_parser(commands)
    segment.add_parser(commands)

    mcap = commands.add_parser("mcap", help="write a drive folder as an MCAP file for ROS 2 (docs/mcap.md)")
    mcap.add_argument("folder", type=Path, help="with drive.json, recorded or rendered")
    mcap.add_argument("--out", type=Path, required=True, help="the file, such as drive.mcap")
    mcap.add_argument("--scans", type=Path, help="scans.json of rendered LiDAR scans, in place of the folder's own")

    check.add_parser(commands)
    estimate.add_parser(commands)

    doctor = commands.add_parser("doctor", help="check the machine and suggest remedies")
    doctor.add_argument("config", nargs="*", help="config files or presets whose requirements to check, too")

    setup.add_parser(commands)

    config = commands.add_parser("config", help="print common settings with defaults: drivesplat config > config.yaml")
    config.add_argument("--all", action="store_true", help="print docs/settings.md, a page of all settings, instead")
    return parser


def _version() -> str:
    try:
        return version("drivesplat")
    except PackageNotFoundError:
        return "of a checkout"


def run_command(parsed: argparse.Namespace) -> int:
    """Runs a command with its parsed arguments. Returns the exit status."""
    if parsed.command == "demo":
        status = run_workflow(["--cores", parsed.cores, "--configfile", "presets/demo.yaml", "--", "all"])
        if status == 0:
            from drivesplat.evaluation.summary import print_summary

            print_summary(results_folder() / "demo")
        return status
    if parsed.command == "show":
        from drivesplat.evaluation.summary import print_summary

        print_summary(parsed.scene)
        return 0
    if parsed.command == check.COMMAND:
        from drivesplat.cli.check.command import run_check

        return run_check(parsed)
    if parsed.command == estimate.COMMAND:
        config = folder_config()
        return estimate.run_estimate(parsed, parsed.results or Path(config.results_dir), config.device.jobs_per_card)
    if parsed.command == "doctor":
        from drivesplat.machine.doctor.__main__ import main as doctor

        return doctor(parsed.config)
    if parsed.command == setup.COMMAND:
        return (0 if setup.is_for_gpus_alone(parsed) else _compile_for_processors()) or setup.run_setup(parsed)
    if parsed.command == "render":
        drive, outputs = drivesplat.open(parsed.folder, parsed.device), parsed.outputs.split(",")
        own = (parsed.camera, outputs, parsed.out, parsed.ego, parsed.film)
        count = drivesplat.render_poses(drive, parsed.poses, *own)
        film = f"; film: {parsed.film}" if parsed.film else ""
        print(f"{parsed.out}: {count} images each of {', '.join(outputs)}, and render.json{film}")
        return 0
    if parsed.command == assets.COMMAND:
        return assets.run_assets(parsed)
    if parsed.command == imports.COMMAND:
        return imports.run_import(parsed)
    if parsed.command == segment.COMMAND:
        return segment.run_segment(parsed)
    if parsed.command == "mcap":
        from drivesplat.export.drive_mcap import write_mcap

        counts = write_mcap(parsed.folder, parsed.out, parsed.scans)
        print(f"{parsed.out}: {sum(counts.values())} messages on {', '.join(counts)}")
        return 0
    if parsed.command == serve.COMMAND:
        return serve.run_serve(parsed)
    if parsed.command == "view":
        drives = [drivesplat.open(folder, parsed.device) for folder in parsed.folders]
        server = drivesplat.LiveServer(drives, parsed.host, parsed.port, parsed.edits)
        print(f"{server.url} shows {drives[0].where}; Ctrl-C ends it", flush=True)
        try:
            server.wait()
        except KeyboardInterrupt:
            server.close()
        return 0
    if parsed.command == "open":
        print(open_viewer(parsed.results or results_folder(), parsed.scene, parsed.method))
    else:  # config
        print((WORKFLOW / ("docs/settings.md" if parsed.all else "config.yaml")).read_text(encoding="utf-8"), end="")
    return 0


def _compile_for_processors() -> int:
    """Compiles gsplat, where there is an NVIDIA card, and the kernels for processors. Returns the exit status."""
    from drivesplat.machine.gsplat_build.__main__ import main as compile_gsplat
    from drivesplat.training.warm_up import main as train_briefly
    from drivesplat.world.warm_up import main as make_tiny_world

    return compile_gsplat([]) or train_briefly() or make_tiny_world()


def snakemake_command(arguments: Sequence[str]) -> list[str]:
    """The command line of Snakemake for the workflow of this copy. Presets and profiles that it brings along are found
    from any folder; the default profile is that beside the Snakefile, unless the current folder has one."""
    found = []
    for argument in arguments:  # also of the form --option=value
        option, equals, value = argument.partition("=") if argument.startswith("--") else ("", "", argument)
        along = value.startswith(BROUGHT_ALONG)
        found.append(f"{option}{equals}{of_the_workflow(value)}" if along else argument)
    return [sys.executable, "-m", "snakemake", "--snakefile", str(SNAKEFILE), *found]


def run_workflow(arguments: Sequence[str]) -> int:
    """Runs Snakemake with the `arguments`. Returns its exit status."""
    # the current folder is no place to import from: it may be another copy's checkout
    process = subprocess.Popen(snakemake_command(arguments), env={**os.environ, "PYTHONSAFEPATH": "1"})
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Snakemake gets it, too, and ends its jobs first
    try:
        return process.wait()
    finally:
        signal.signal(signal.SIGINT, before)


def folder_config() -> "Config":
    """The settings of the current folder's config.yaml, by default those of the workflow. Raises ConfigError."""
    from drivesplat.io.yaml_file import read_yaml
    from drivesplat.settings.config import load

    return load(read_yaml(default_config(Path.cwd()), "config file") or {})


def results_folder() -> Path:
    """The results folder of the current folder's config.yaml, by default `results`. Raises ConfigError."""
    return Path(folder_config().results_dir)


def open_viewer(results: Path, scene: str | None, method: str | None) -> str:
    """Opens the page of a scene and method in the browser; returns what was opened, and which others there are.

    Raises DriveSplatError where there is no such page, or no browser.
    """
    pages = exported_pages(results)
    page = chosen_page(pages, results, scene, method)
    if not webbrowser.open_new_tab(page.resolve().as_uri()):
        raise DriveSplatError(f"no browser was found; open {page.resolve()} in one, also on another machine")
    others = [f"{at[0]} {at[1]}" for at, other in sorted(pages.items()) if other != page]
    return f"opened {page}" + (f"; there are also: {', '.join(others)}" if others else "")


def exported_pages(results: Path) -> dict[tuple[str, str], Path]:
    """The exported pages below a results folder, by scene and method."""
    found = sorted(results.glob(f"*/*/{PAGE}"))
    return {(page.parent.parent.name, page.parent.name): page for page in found}


def chosen_page(
    pages: dict[tuple[str, str], Path], results: Path, scene: str | None = None, method: str | None = None
) -> Path:
    """The page of a scene and method: by default of the scene exported last, and there of a method with moving objects.
    Raises DriveSplatError where there is none."""
    matching = {at: page for at, page in pages.items() if scene in (None, at[0]) and method in (None, at[1])}
    if not matching:
        wanted = f"{results / (scene or '{scene}') / (method or '{method}') / PAGE}"
        known = ", ".join(f"{at[0]} {at[1]}" for at in sorted(pages)) or "none"
        raise DriveSplatError(
            f"there is no {wanted}; exported are: {known}. The workflow exports a scene with "
            f"`drivesplat run --cores 1 -- {wanted}`; with --results the pages of another folder are opened"
        )
    newest = max(matching, key=lambda at: matching[at].stat().st_mtime)[0]
    of_scene = [page for at, page in matching.items() if at[0] == newest]
    return max(of_scene, key=lambda page: (page.with_name(OF_MOVING_OBJECTS).is_file(), page.stat().st_mtime))


if __name__ == "__main__":
    sys.exit(main(program="python -m drivesplat.cli"))
