"""Places of results in Snakemake's report (`--report report.zip`), which keeps every file in a folder of its own."""

from pathlib import Path

from snakemake.common import get_report_id
from snakemake.iocontainers import FILE_HASH_PREFIX_LEN


def address_in_archive(result: Path) -> str:
    """The address of a result, marked `report` in its rule, from a page beside it in the archive. `result` is the path
    that its rule declares, relative to the working folder."""
    return f"../{get_report_id(result)[:FILE_HASH_PREFIX_LEN]}/{result.name}"
