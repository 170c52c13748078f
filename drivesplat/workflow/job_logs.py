"""What logs of jobs say (`drivesplat.workflow.job` writes them)."""

import re

_FAILURE = re.compile(r"ERROR drivesplat\.workflow\.job: (\S+?)(?: \S+)?: (.*)")
"""How a failed job ends its log: its stage, its scene where it has one, and why."""
_BEGINS = re.compile(r"INFO drivesplat\.workflow\.job: .* begins$", re.MULTILINE)
_ENDS = re.compile(r"INFO drivesplat\.workflow\.job: .* ends\s*$")


def failures(text: str) -> dict[str, str]:
    """The stages that failed, with their reasons, in the order of a log or of several logs' text; a stage's first
    reason counts."""
    found: dict[str, str] = {}
    for stage, why in _FAILURE.findall(text):
        found.setdefault(stage, why)
    return found


def has_begun(text: str) -> bool:
    """Whether a job's log has a beginning."""
    return bool(_BEGINS.search(text))


def is_cut_short(text: str) -> bool:
    """Whether a job's log has a beginning and no end: the job was killed, or is at work."""
    return has_begun(text) and not _ENDS.search(text) and not failures(text)
