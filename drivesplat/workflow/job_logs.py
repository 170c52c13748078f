"""Reading the logs of jobs, which `drivesplat.workflow.job` writes."""

import re
from pathlib import Path

NOT_MEASURED = "not measured"
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


def has_failed(log: Path, since: float) -> bool:
    """Whether a job that wrote this log since a time (seconds of the epoch), and no longer runs, failed or was
    killed."""
    try:
        text = log.read_text(encoding="utf-8", errors="replace") if log.stat().st_mtime >= since else ""
    except OSError:
        return False
    return bool(failures(text)) or is_cut_short(text)


def why_missing(logs: Path, scene: str) -> str:
    """Why a scene has no result: the message of the job that failed last (each log is that of the last attempt), else
    the name of an interrupted job, else NOT_MEASURED."""
    files = sorted((logs / scene).rglob("*.log"), key=lambda file: file.stat().st_mtime, reverse=True)
    texts = {file: file.read_text(encoding="utf-8", errors="replace") for file in files}
    for text in texts.values():
        for stage, why in failures(text).items():
            return f"{stage}: {why}"
    for file, text in texts.items():
        if is_cut_short(text):
            return f"{file.relative_to(logs / scene).with_suffix('')} was interrupted, or is still running"
    return NOT_MEASURED
