"""The metadata of a store of NCore: the content of all of its `.zgroup`, `.zattrs` and `.zarray` files by their paths.

Stores hold it once more in one member, cbor in an xz container. Planning reads it without Zarr; `cbor2` is imported
when it does. An indexed tar file ends with a block of 512 bytes that gives the position of its index.
"""

import lzma
import struct
from pathlib import Path
from typing import Any

from drivesplat.errors import DatasetError
from drivesplat.io.regular_file import regular_file

Metadata = dict[str, dict[str, Any]]
METADATA = ".zmetadata.cbor.xz"
BLOCK, HEADER, MAGIC = 512, struct.Struct("<4sIQI"), b"itar"
MAX_BYTES = 500_000_000
"""Maximum number of bytes of a member, packed or not."""


def store_metadata(store: Path) -> Metadata:
    """The metadata of a store, by paths such as `cameras/front/frames/.zattrs`.

    Raises DatasetError naming the store where it is damaged, and what to install where `cbor2` is missing.
    """
    try:
        import cbor2
    except ImportError:
        raise DatasetError("NCore clips need cbor2: pip install 'drivesplat[ncore]'") from None
    try:
        packed = regular_file(store / METADATA, MAX_BYTES).read_bytes() if store.is_dir() else _member(store, cbor2)
        content = cbor2.loads(_unpacked(packed))["metadata"]
        if not all(isinstance(key, str) and isinstance(value, dict) for key, value in content.items()):
            raise ValueError("it is no table of records")
        return dict(content)
    except DatasetError:
        raise
    except Exception as error:  # lzma, struct and cbor2 each fail in their own ways
        reason = "".join(c if c.isprintable() else " " for c in str(error))[:200]
        raise DatasetError(
            f"store {store} cannot be read ({type(error).__name__}: {reason}); copy the clip again"
        ) from error


def _member(store: Path, cbor2: Any) -> bytes:
    """The packed metadata of an indexed tar file."""
    with regular_file(store).open("rb") as file:
        size = file.seek(0, 2)
        if size < BLOCK:
            raise ValueError("it is too short")
        file.seek(size - BLOCK)
        magic, kind, offset, length = HEADER.unpack(file.read(HEADER.size))
        if magic != MAGIC or kind != 1:
            raise ValueError("it has no index, as a file that was not finished")
        index = cbor2.loads(_unpacked(_bytes_at(file, offset, length, size)))
        at = index["items"].index(METADATA)
        return _bytes_at(file, index["offset_datas"][at], index["sizes"][at], size)


def _bytes_at(file: Any, offset: int, length: int, size: int) -> bytes:
    if not 0 <= offset <= offset + length <= size or length > MAX_BYTES:
        raise ValueError("its index names bytes that are not there")
    file.seek(offset)
    return file.read(length)


def _unpacked(packed: bytes) -> bytes:
    unpacker = lzma.LZMADecompressor()
    content = unpacker.decompress(packed, MAX_BYTES)
    if not unpacker.eof:
        raise ValueError("it is truncated or too large")
    return content
