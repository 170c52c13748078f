"""The reason why a scene has no result, from the logs of its jobs."""

from pathlib import Path

from drivesplat.workflow.job_logs import failures, is_cut_short

NOT_MEASURED = "not measured"


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
