"""The records of a TFRecord file: uint64 length, masked CRC-32C of it, data, masked CRC-32C of the data; all
little-endian. tensorflow/core/lib/io/record_writer.h documents the format, crc32c.h the mask."""

import struct
from collections.abc import Iterator
from pathlib import Path

import google_crc32c

from drivesplat.errors import DatasetError

_HEADER, _FOOTER = struct.Struct("<QI"), struct.Struct("<I")


def records(path: Path) -> Iterator[bytes]:
    """The records of a file, one at a time. Raises DatasetError naming the record where the file is truncated or a
    checksum differs."""
    size = path.stat().st_size
    with path.open("rb") as file:
        number = 0
        while file.tell() < size:
            record = f"record {number} of {path}"
            header = file.read(_HEADER.size)
            if len(header) < _HEADER.size:
                raise _truncated(record)
            length, checksum = _HEADER.unpack(header)
            if masked_crc(header[:8]) != checksum:
                raise _altered(record, "length")
            if length > size - file.tell() - _FOOTER.size:
                raise _truncated(record)
            data, footer = file.read(length), file.read(_FOOTER.size)
            if len(data) < length or len(footer) < _FOOTER.size:
                raise _truncated(record)
            if masked_crc(data) != _FOOTER.unpack(footer)[0]:
                raise _altered(record, "data")
            yield data
            number += 1


def masked_crc(data: bytes) -> int:
    """The masked CRC-32C of a record's part."""
    crc = google_crc32c.value(data)
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def _truncated(record: str) -> DatasetError:
    return DatasetError(f"{record} is truncated; download the file again")


def _altered(record: str, part: str) -> DatasetError:
    return DatasetError(f"{record}: the checksum (CRC-32C) of its {part} differs; download the file again")
