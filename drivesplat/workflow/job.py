"""The interface between rules' scripts and the library: settings, provenance, logs, and errors in one line."""

import errno
import gc
import json
import logging
import sys
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

from drivesplat.errors import DriveSplatError
from drivesplat.io.storage import Provenance, unwritable
from drivesplat.io.this_copy import in_this_copy
from drivesplat.provenance.file_digests import check_dataset, checked_digest, file_digests, member_states, record_output
from drivesplat.provenance.record import provenance
from drivesplat.settings import Settings
from drivesplat.settings.device import DeviceSettings
from drivesplat.settings.track_references import TrackReferences
from drivesplat.settings.tracks import OTHER_TRACKS
from drivesplat.workflow import IN_SCRIPT
from drivesplat.workflow.gpus import hold_gpu
from drivesplat.workflow.running_code import RunningCode

S = TypeVar("S", bound=Settings)

REFUSED_BY_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
"""Errors of the disk, not of the workflow."""

if IN_SCRIPT:
    gc.disable()  # until the job begins: imported objects stay, and collecting garbage among them takes 0.5 s


class Job:
    """The files, settings and code digest of a rule, for its script; never the whole config."""

    def __init__(self, snakemake: Any):
        self.input = snakemake.input
        self.output = snakemake.output
        self.wildcards = snakemake.wildcards
        self.log = snakemake.log
        self.threads: int = snakemake.threads
        self._rule: str = snakemake.rule
        self._params = snakemake.params
        self._resources = snakemake.resources
        self._gpu: BinaryIO | None = None
        self._read: dict[str, str] = {}
        self._members = {str(path): member_states(path) for path in self.output}
        self._dataset: dict[str, dict[str, str]] = {}

    @property
    def stage(self) -> str:
        """The name of this stage in provenance records, prefixed by the method if it has one: that of the script, since
        a workflow that imports this one may rename its rules."""
        main, method = sys.modules["__main__"], getattr(self.wildcards, "method", None)
        name = Path(main.__file__).stem if hasattr(main, "snakemake") and hasattr(main, "__file__") else self._rule
        return f"{method}/{name}" if method else name

    @property
    def name(self) -> str:
        """Stage and scene, for messages."""
        of_tracks = getattr(self.wildcards, "tracks", "")
        return " ".join([of_tracks + self.stage, *([self.wildcards.scene] if hasattr(self.wildcards, "scene") else [])])

    def settings(self, model: type[S]) -> S:
        """The rule's settings as the record it expects."""
        return model.model_validate_json(self._params.settings)

    def device(self) -> DeviceSettings:
        """The device to run on; not part of the settings, since it changes no result. Reserves a GPU for the job until
        it ends, where there is one, and hides all others."""
        settings = DeviceSettings.model_validate_json(self._resources.device)
        if settings.kind != "cpu" and self._gpu is None:  # a second lock would wait for the first
            self._gpu = hold_gpu(settings.jobs_per_card)
        return settings

    def track_references(self) -> TrackReferences:
        """The tracks that the settings of the scene name."""
        return TrackReferences.model_validate_json(self._resources.track_references)

    def provenance(self, *upstream: Provenance, inputs: dict[str, str] | None = None) -> Provenance:
        """The provenance of this rule's result, made from results with the provenances `upstream`."""
        return provenance(self.stage, json.loads(self._params.settings), self._params.code, upstream, inputs or {})

    def check_inputs(self, dataset: Iterable[str] = ()) -> None:
        """Compares the inputs with what their rules wrote, and the dataset's files of the kinds `dataset` ('images',
        'sweeps') with what `extract` read. Raises ResultError naming an altered file and the rule that rebuilds it."""
        scene, parents = getattr(self.wildcards, "scene", None), Path(next(iter(self.output), "")).parents
        # in the folder of the scene's results every file has a record; None for a rule without a scene
        results = next((folder for folder in reversed(parents) if scene and folder.name == scene), None)

        def digest(path: str) -> str:
            return checked_digest(path, warn=results is not None and results in Path(path).parents)

        paths = [str(path) for path in self.input]
        with ThreadPoolExecutor() as pool:
            self._read.update(zip(paths, pool.map(digest, paths), strict=True))
        if dataset:
            record = self.input.scene if hasattr(self.input, "scene") else self.input.parser
            folder = Path(record).parent
            check_dataset(folder.parent if folder.name in OTHER_TRACKS else folder, dataset)

    def record_dataset(self, **files: Iterable[str | Path]) -> None:
        """Computes the digests of the dataset's `files` by kind, for the record beside the outputs."""
        self._dataset = {
            kind: file_digests(path for path in paths if Path(path).is_file()) for kind, paths in files.items()
        }

    def record_outputs(self) -> None:
        """Writes the digests of all files that the job has read and written."""

        def record(path: str) -> None:
            record_output(path, self._rule, self._members[path], self._read, self._dataset)

        with ThreadPoolExecutor() as pool:
            list(pool.map(record, self._members))


@contextmanager
def job(snakemake: Any, dataset: Iterable[str] = (), check_inputs: bool = True) -> Iterator[Job]:
    """The context of a rule's script: logs into the rule's log, and reports a failure in one line on the console.

    Inputs are compared with what their rules wrote, unless the script does that itself (`check_inputs`); `dataset` are
    the kinds of the dataset's files that the script reads ('images', 'sweeps').

    A DriveSplatError is reported by its message, a full or read-only disk by the file; anything else is a bug, reported
    with the log that has its traceback.
    """
    gc.freeze()  # imports are never collected, which would take most of the time when a script ends
    gc.enable()
    log_path = Path(snakemake.log[0])
    _log_into(log_path)
    current, log, threading_hook = Job(snakemake), logging.getLogger(__name__), threading.excepthook
    # the caller that waits for a thread reports its failure to the user
    threading.excepthook = lambda failed: log.info("a thread fails: %s: %s", failed.exc_type.__name__, failed.exc_value)
    log.info("%s begins", current.name)
    try:
        # None where Snakemake has not started the script of the rule
        code = RunningCode(snakemake.params.code) if hasattr(sys.modules["__main__"], "__real_file__") else None
        if code:
            code.check()
        if check_inputs:
            current.check_inputs(dataset)
        yield current
        if code:
            code.check_late_imports()
        current.record_outputs()
        log.info("%s ends", current.name)
    except DriveSplatError as error:
        log.error("%s: %s", current.name, in_this_copy(str(error)))
        sys.exit(1)
    except Exception as error:
        if isinstance(error, OSError) and error.errno in REFUSED_BY_DISK:
            log.error("%s: %s", current.name, unwritable(error.filename or "a file", error))
        elif isinstance(error, FileNotFoundError) and str(error.filename) in {*current.input, *current.output}:
            log.error("%s: %s was removed while the job ran; start again", current.name, error.filename)
        else:
            log.info("%s ends with this:", current.name, exc_info=True)
            message = "%s: %s: %s (a bug; the traceback is in %s)"
            log.error(message, current.name, type(error).__name__, error, log_path)
        sys.exit(1)
    finally:
        threading.excepthook = threading_hook
        logging.shutdown()
        gc.freeze()


def _log_into(path: Path) -> None:
    """Logs into the file at `path`; warnings and errors also go to the console."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handler = logging.FileHandler(path, mode="w", encoding="utf-8")
    except OSError as error:
        sys.exit(f"drivesplat: {unwritable(path, error)}")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    console = logging.StreamHandler(sys.stderr)
    console.setLevel(logging.WARNING)
    console.setFormatter(logging.Formatter("drivesplat: %(message)s"))
    logging.basicConfig(level=logging.INFO, handlers=[handler, console], force=True)
    logging.captureWarnings(True)
    logging.raiseExceptions = False  # where the disk has no room for a log, what the job was to write says so, once
