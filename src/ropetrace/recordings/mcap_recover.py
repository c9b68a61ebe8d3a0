"""Finishes an MCAP file whose recorder was killed: cuts off the half frame at its end, and writes the index."""

from __future__ import annotations

import mmap
import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Schema

from ropetrace.errors import RecordingError
from ropetrace.recordings.decompress import DamageError, decompress
from ropetrace.recordings.mcap_append import (
    COMPRESSION,
    LIBRARY,
    ChunkRecord,
    Entries,
    McapIndex,
    message_indexes,
)
from ropetrace.recordings.mcap_parts import CHUNK, HEAD, MAGIC, MESSAGE, parsed, read_summary, split
from ropetrace.recordings.ros_messages import MAX_MESSAGE_BYTES
from ropetrace.results.base import lock, uninterrupted, writing

_BLOCK = 2**24


@dataclass(frozen=True, slots=True)
class Recovered:
    """What became of a file.

    Parameters
    ----------
    messages : int
        In the file now.
    cut : int
        Bytes of its end that were no whole frame, and were cut off.
    was_whole : bool
        Whether nothing was to be done.
    """

    messages: int
    cut: int
    was_whole: bool


def recover(path: Path, on_bytes: Callable[[int], object] = lambda count: None) -> Recovered:
    """Finish a file, in place; its frames stay where they are.

    Parameters
    ----------
    path : Path
        Written by `ropetrace.recordings.mcap_append.McapAppender`.
    on_bytes : callable
        Is told how many more bytes were checked.

    Raises
    ------
    RecordingError
        If it is no such file, holds no whole frame, or is damaged before its end: then nothing is changed.
    OutputError
        If another process writes to it, or it cannot be changed.
    """
    if not path.is_file():
        raise RecordingError(f"{path}: there is no such file")
    with writing(path), path.open("r+b") as file:
        lock(file, path)
        size = os.fstat(file.fileno()).st_size
        summary = read_summary(file, size, [])
        if summary is not None and summary.statistics is not None:
            return Recovered(summary.statistics.message_count, 0, True)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise RecordingError(f"{path}: not an MCAP file")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if not _library(data).startswith(LIBRARY):
                raise RecordingError(
                    f"{path}: not written by ropetrace: nothing was changed; copy the frames that can be read with "
                    f"`ropetrace record {path} --out copy.mcap`"
                )
            whole = _whole_part(path, data, on_bytes)
            if _chunk_follows(data, whole.end):
                raise RecordingError(
                    f"{path}: damaged at byte {whole.end}, and whole frames follow: nothing was changed; copy the "
                    f"frames that can be read with `ropetrace record {path} --out copy.mcap`"
                )
            crc = _checksum(data, whole.end)
        if not whole.index.chunks:
            raise RecordingError(f"{path}: holds no whole frame: nothing was changed")
        ending = whole.missing + whole.index.ending(whole.end + len(whole.missing), zlib.crc32(whole.missing, crc))
        with uninterrupted():
            file.seek(whole.end)
            file.write(ending)
            file.truncate()
            file.flush()
            os.fsync(file.fileno())
    return Recovered(whole.index.counts.total(), size - whole.end, False)


@dataclass(slots=True)
class _Whole:
    """The whole records at the front of a file."""

    index: McapIndex
    end: int
    """Where they end; of the last chunk's message indexes all are within, or none."""
    missing: bytes = b""
    """The message indexes of the last chunk, if they are not within."""


def _whole_part(path: Path, data: mmap.mmap, on_bytes: Callable[[int], object]) -> _Whole:
    whole = _Whole(McapIndex(), len(MAGIC))
    offset = whole.end
    pending: tuple[ChunkRecord, Entries] | None = None
    found: dict[int, bytes] = {}
    expected: dict[int, bytes] = {}
    for opcode, start, length in _records(data, offset):
        payload = data[start + HEAD.size : start + length]
        if opcode != Opcode.MESSAGE_INDEX and pending is not None:
            whole.index.add_chunk(*pending, found)
            pending, found = None, {}
        try:
            if opcode == Opcode.CHUNK:
                pending = _chunk(whole.index, start, payload)
                expected = message_indexes(pending[1])
            elif opcode == Opcode.MESSAGE_INDEX:
                (channel,) = struct.unpack_from("<H", payload)
                if data[start : start + length] != expected.get(channel):
                    break  # no checksum tells that it is damaged
                found[channel] = expected[channel]
            elif opcode == Opcode.METADATA:
                whole.index.add_metadata(parsed(Metadata, payload).name, start, length)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                _introduce(whole.index, opcode, payload)
            elif opcode == Opcode.DATA_END:
                return whole
            elif opcode != Opcode.HEADER:
                raise RecordingError(f"{path}: has a record of type {opcode} at byte {start}: not written by ropetrace")
        except (DamageError, struct.error):
            break
        offset = start + length
        on_bytes(length)
        if pending is None or found == expected:
            whole.end = offset
    if pending is not None:
        chunk, entries = pending
        if found != expected:
            whole.end, whole.missing = chunk.offset + chunk.length, b"".join(expected.values())
        whole.index.add_chunk(chunk, entries, expected)
    return whole


def _library(data: mmap.mmap) -> str:
    """What wrote a file, as its header tells; empty without one."""
    opcode, start, length = next(_records(data, len(MAGIC)), (0, 0, 0))
    if opcode != Opcode.HEADER:
        return ""
    try:
        return str(parsed(Header, data[start + HEAD.size : start + length]).library)
    except DamageError:
        return ""


def _records(data: mmap.mmap, offset: int) -> Iterator[tuple[int, int, int]]:
    """Type, offset and length, with the head, of each whole record from an offset on."""
    while offset + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, offset)
        if not opcode or length > min(MAX_MESSAGE_BYTES, len(data) - offset - HEAD.size):
            return
        yield opcode, offset, HEAD.size + length
        offset += HEAD.size + length


def _chunk(index: McapIndex, start: int, payload: bytes) -> tuple[ChunkRecord, Entries]:
    """A chunk, and the places of its messages; its schemas and channels are added to the index.

    Raises
    ------
    DamageError, struct.error
        If it is damaged.
    """
    _, _, size, crc, name_bytes = CHUNK.unpack_from(payload)
    body = CHUNK.size + name_bytes + 8
    name = payload[CHUNK.size : body - 8].decode(errors="replace")
    content = decompress(name, memoryview(payload)[body:], size, MAX_MESSAGE_BYTES)
    if zlib.crc32(content) != crc:
        raise DamageError(start, "wrong checksum")
    entries: Entries = {}
    offset = 0
    for opcode, record in split(content):
        if opcode == Opcode.MESSAGE:
            channel, _, log_time, _ = MESSAGE.unpack_from(record)
            entries.setdefault(channel, []).append((log_time, offset))
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            _introduce(index, opcode, record)
        offset += HEAD.size + len(record)
    return ChunkRecord(start, HEAD.size + len(payload), name, len(payload) - body, size), entries


def _introduce(index: McapIndex, opcode: int, record: bytes | memoryview) -> None:
    if opcode == Opcode.SCHEMA:
        schema = parsed(Schema, record)
        index.schemas[schema.id] = schema
    else:
        channel = parsed(Channel, record)
        index.channels[channel.id] = channel


def _chunk_follows(data: mmap.mmap, offset: int) -> bool:
    """Whether there is a whole chunk somewhere behind the whole part: then its end is no end, but damage."""
    mark = struct.pack("<I", len(COMPRESSION)) + COMPRESSION.encode()
    before = HEAD.size + CHUNK.size - 4
    while (place := data.find(mark, offset + before)) >= 0:
        start, offset = place - before, place - before + 1
        opcode, begin, length = next(_records(data, start), (0, 0, 0))
        if opcode == Opcode.CHUNK:
            try:
                _chunk(McapIndex(), begin, data[begin + HEAD.size : begin + length])
            except (DamageError, struct.error):
                continue
            return True
    return False


def _checksum(data: mmap.mmap, end: int) -> int:
    crc = 0
    for start in range(0, end, _BLOCK):
        crc = zlib.crc32(data[start : min(start + _BLOCK, end)], crc)
    return crc
