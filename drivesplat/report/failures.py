"""Why a scene has no result: what the logs of its jobs say."""

from pathlib import Path

from drivesplat.workflow.job_logs import failures, is_cut_short

NOT_MEASURED = "not measured"


def why_missing(logs: Path, scene: str) -> str:
    """Why a scene has no result: what the last of its jobs to fail has said, each log being that of the last try; which
    job was ended in the middle; or that nobody has tried."""
    files = sorted((logs / scene).rglob("*.log"), key=lambda file: file.stat().st_mtime, reverse=True)
    texts = {file: file.read_text(encoding="utf-8", errors="replace") for file in files}
    for text in texts.values():
        for stage, why in failures(text).items():
            return f"{stage}: {why}"
    for file, text in texts.items():
        if is_cut_short(text):
            return f"{file.relative_to(logs / scene).with_suffix('')} was ended in the middle, or is at work"
    return NOT_MEASURED
