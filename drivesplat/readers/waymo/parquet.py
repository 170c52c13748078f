"""Rows of Waymo's parquet files, read in small batches: memory does not grow with the length of a segment."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from drivesplat.errors import DatasetError
from drivesplat.readers.record_names import shown

SEGMENT = "key.segment_context_name"
BUFFER = 1 << 20
"""Bytes that are read of a column at once: less than its whole chunk, which may hold all images of a segment."""


def rows(path: Path, columns: Sequence[str], segment: str, batch: int = 256) -> Iterator[dict[str, Any]]:
    """The rows of a file, with these columns by name: numbers and texts as Python has them, lists as lists, binary
    values as bytes. Names without a file's prefix are those after `]`.

    Raises DatasetError naming the file where it is damaged, lacks a column, or holds another segment.
    """
    for found in batches(path, columns, segment, batch):
        values = [column.to_pylist() for column in found.columns]
        yield from (dict(zip(columns, row, strict=True)) for row in zip(*values, strict=True))


def batches(path: Path, columns: Sequence[str], segment: str, batch: int) -> Iterator[pa.RecordBatch]:
    """The same, as batches of at most `batch` rows with the columns in the given order."""
    wanted = [SEGMENT, *columns]
    try:
        with pq.ParquetFile(path, buffer_size=BUFFER, pre_buffer=False, page_checksum_verification=True) as file:
            absent = [name for name in wanted if name not in file.schema_arrow.names]
            if absent:
                raise DatasetError(f"{path} has no column {absent[0]}; download it again")
            for found in file.iter_batches(batch_size=batch, columns=wanted, use_threads=False):
                named = set(found.column(SEGMENT).to_pylist())
                if named - {segment}:
                    raise DatasetError(f"{path} holds segment {shown((named - {segment}).pop())}, not {segment}")
                yield found.select(list(columns))
    except (pa.ArrowException, OSError, OverflowError, UnicodeDecodeError, KeyError) as error:
        reason = " ".join(str(error).split())[:200]
        raise DatasetError(f"{path} cannot be read ({reason}); download it again") from error


def whole(value: Any, path: Path, column: str) -> int:
    """A whole number, which may be text. Raises DatasetError naming the file and the column for anything else."""
    try:
        if isinstance(value, bool | float) and value != int(value):
            raise ValueError
        return int(value)
    except (OverflowError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: a {column} is {shown(value)}; it must be a whole number") from error
