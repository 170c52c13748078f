"""The code that a rule's script runs, compared with the code that its run was planned with."""

import json
import os
import sys
from collections.abc import Callable
from pathlib import Path

from drivesplat.errors import DriveSplatError
from drivesplat.provenance.code.code_digest import PACKAGE, code_digest, code_files
from drivesplat.provenance.code.code_states import file_state
from drivesplat.workflow import CODE_AT_START

PLANNED = "DRIVESPLAT_PLANNED"
"""The environment variable with the digests that a run was planned with as JSON, for the processes of its jobs."""


def planned_digest(name: str, compute: Callable[[], str], is_main: bool) -> str:
    """A digest that the run was planned with: the main process computes it, and hands it to those of jobs, which on a
    cluster plan again, perhaps after the file has changed."""
    handed = json.loads(os.environ.get(PLANNED, "{}"))
    if is_main or name not in handed:
        handed[name] = compute()
        os.environ[PLANNED] = json.dumps(handed)
    return handed[name]


class RunningCode:
    """The code of the script in this process; `planned` is the digest of its stage's code in the plan."""

    def __init__(self, planned: str):
        main = sys.modules["__main__"]
        self._planned = planned
        self._script = Path(main.__file__ or "")
        self._copy = Path(main.__real_file__)
        """What runs: Snakemake's copy of the script, after its preamble."""
        self._imported: set[str] = set()

    def check(self) -> None:
        """Raises DriveSplatError where the code differs from the planned code, or where a file of it has changed, even
        if back again, since this process began to import it."""
        modules, pages = code_files(self._script)
        same_script = self._copy.read_text("utf-8").endswith(self._script.read_text("utf-8"))
        if not same_script or code_digest(self._script) != self._planned:
            raise self._changed()
        self._refuse_changed([*modules, *pages])
        self._imported = {*sys.modules}

    def check_late_imports(self) -> None:
        """Raises DriveSplatError where a file that the job may have read since `check` has changed since then."""
        late = [sys.modules[name] for name in {*sys.modules} - self._imported if name.partition(".")[0] == PACKAGE]
        _, pages = code_files(self._script)
        self._refuse_changed([*(Path(module.__file__) for module in late if module.__file__), *pages])

    def _refuse_changed(self, files: list[Path]) -> None:
        if any(file_state(file) != CODE_AT_START.get(file) for file in files):
            raise self._changed()

    def _changed(self) -> DriveSplatError:
        return DriveSplatError(f"code of {self._script.stem} changed since the run was planned; start again")
