"""Reading the logs of jobs, which `drivesplat.workflow.job` writes."""

import re

_FAILURE = re.compile(r"ERROR drivesplat\.workflow\.job: (\S+?)(?: \S+)?: (.*)")
"""The last line of a failed job's log: its stage, its scene if it has one, and the reason."""
_BEGINS = re.compile(r"INFO drivesplat\.workflow\.job: .* begins$", re.MULTILINE)
_ENDS = re.compile(r"INFO drivesplat\.workflow\.job: .* ends\s*$")


def failures(text: str) -> dict[str, str]:
    """The first reason of every failed stage, in the order of the text of one or several logs."""
    found: dict[str, str] = {}
    for stage, why in _FAILURE.findall(text):
        found.setdefault(stage, why)
    return found


def has_begun(text: str) -> bool:
    """Whether a job's log has a beginning."""
    return bool(_BEGINS.search(text))


def is_cut_short(text: str) -> bool:
    """Whether a job's log has a beginning and no end: the job was killed, or is running."""
    return has_begun(text) and not _ENDS.search(text) and not failures(text)
