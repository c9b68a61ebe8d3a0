"""Decompression that stops at a bound, whatever the data declare."""

from __future__ import annotations

import bz2
from collections.abc import Callable
from typing import Any

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from ropetrace.recordings.base import one_line

_STEP = 4 * 2**20


class DamageError(Exception):
    """Stored bytes are not what they must be: where, and why. Never leaves the readers."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset = offset
        self.reason = reason


def decompress(method: str, data: bytes | memoryview, size: int, limit: int) -> bytes | memoryview:
    """Decompress to exactly `size` bytes.

    Parameters
    ----------
    method : str
        ``zstd``, ``lz4``, ``bz2``, and ``none`` or an empty text.
    data : bytes
        What is stored.
    size : int
        The size that is declared for the result, bytes.
    limit : int
        More is refused before anything is allocated, bytes.

    Raises
    ------
    DamageError
        If the data are damaged, of an unknown method, too large, or not of the declared size.
    """
    if size > limit:
        raise DamageError(0, f"it declares {size} bytes, {limit} are taken")
    if method in ("", "none"):
        if len(data) != size:
            raise DamageError(0, f"it declares {size} bytes and holds {len(data)}")
        return data
    try:
        if method == "zstd":
            with zstandard.ZstdDecompressor().stream_reader(data) as reader:
                result = _bounded(reader.read, size)
        elif method == "lz4":
            result = _whole(lz4.frame.LZ4FrameDecompressor(), data, size)
        elif method == "bz2":
            result = _whole(bz2.BZ2Decompressor(), data, size)
        else:
            raise DamageError(0, f"unknown compression {method!r}")
    except DamageError:
        raise
    except Exception as error:
        raise DamageError(0, f"{method}: {one_line(error)}") from None
    if len(result) != size:
        raise DamageError(
            0, f"it declares {size} bytes and decompresses to {'more' if len(result) > size else len(result)}"
        )
    return result


def _whole(decompressor: Any, data: bytes | memoryview, size: int) -> bytes:
    """At most one byte more than `size`; the checksum of the data stands at their end."""
    result: bytes = decompressor.decompress(bytes(data), max_length=size + 1)
    if len(result) <= size and not decompressor.eof:
        raise DamageError(0, "the compressed data are cut off")
    return result


def _bounded(read: Callable[[int], bytes], size: int) -> bytes:
    """At most one byte more than `size`, in steps: memory grows with what is there, not with what is said."""
    parts: list[bytes] = []
    found = 0
    while found <= size:
        part = read(min(_STEP, size + 1 - found))
        if not part:
            break
        parts.append(part)
        found += len(part)
    return b"".join(parts)
