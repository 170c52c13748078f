"""Rows of Waymo's parquet files, read in small batches: memory does not grow with the length of a segment."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from drivesplat.errors import DatasetError
from drivesplat.readers.record_names import shown

SEGMENT = "key.segment_context_name"
TEXTS = (SEGMENT, "key.laser_object_id")
LISTS, BYTES = (".transform", ".values", ".shape"), (".image", ".panoptic_label")
"""Ends of names of columns that hold lists of numbers, or bytes."""
BUFFER = 1 << 20
"""Bytes that are read of a column at once: less than its whole chunk, which may hold all images of a segment."""


def rows(path: Path, columns: Sequence[str], segment: str, batch: int = 256) -> Iterator[dict[str, Any]]:
    """The rows of a file, with these columns by name: numbers and texts as Python has them, lists as lists, binary
    values as bytes.

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
            wrong = next((name for name in wanted if not _fits(name, file.schema_arrow.field(name).type)), None)
            if wrong:
                kind = file.schema_arrow.field(wrong).type
                raise DatasetError(f"{path}: its column {wrong} is of type {kind}; download it again")
            for found in file.iter_batches(batch_size=batch, columns=wanted, use_threads=False):
                named = set(found.column(SEGMENT).to_pylist())
                if named - {segment}:
                    raise DatasetError(f"{path} holds segment {shown((named - {segment}).pop())}, not {segment}")
                yield found.select(list(columns))
    except (pa.ArrowException, OSError, OverflowError, UnicodeDecodeError, KeyError) as error:
        reason = "".join(c if c.isprintable() else " " for c in str(error))
        reason = " ".join(reason.split())[:200]
        raise DatasetError(f"{path} cannot be read ({reason}); download it again") from error


def _fits(name: str, kind: pa.DataType) -> bool:
    """Whether a column's type can hold its values: lists of numbers, bytes, texts, or numbers, of keys also as text."""
    is_text = pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_dictionary(kind)
    if name in TEXTS:
        return is_text or pa.types.is_null(kind)
    if name.endswith(BYTES):
        return pa.types.is_binary(kind) or pa.types.is_large_binary(kind)
    if name.endswith(LISTS):
        is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind) or pa.types.is_fixed_size_list(kind)
        return pa.types.is_null(kind) or (is_list and _is_number(kind.value_type))
    return _is_number(kind) or (is_text and name.startswith("key."))


def _is_number(kind: pa.DataType) -> bool:
    return pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_null(kind)


def whole(value: Any, path: Path, column: str) -> int:
    """A whole number, which may be text. Raises DatasetError naming the file and the column for anything else."""
    try:
        if isinstance(value, bool | float) and value != int(value):
            raise ValueError
        return int(value)
    except (OverflowError, TypeError, ValueError) as error:
        raise DatasetError(f"{path}: a {column} is {shown(value)}; it must be a whole number") from error
