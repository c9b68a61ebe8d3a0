"""The pieces that an MCAP file is made of, and what its end says of the rest."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Footer, Schema, Statistics

from ropetrace.recordings.base import note, one_line, printable
from ropetrace.recordings.decompress import DamageError
from ropetrace.recordings.ros_messages import ros2_type

MAGIC = b"\x89MCAP0\r\n"
HEAD = struct.Struct("<BQ")
"""A record's type and length."""

CHUNK = struct.Struct("<QQQII")
"""The front of a chunk: times of its first and last message, bytes and checksum of its content, length of the name of
its compression."""

MESSAGE = struct.Struct("<HIQQ")
"""The front of a message: channel, sequence, time of recording and of publication."""

MAX_SUMMARY_BYTES = 4 * 2**30
"""The largest summary that is read: that of two weeks of depth and colour at 30 Hz, a chunk each."""

_FOOTER_BYTES = 29


@dataclass(slots=True)
class Channels:
    """The schemas and channels met so far."""

    schemas: dict[int, str] = field(default_factory=dict)
    channels: dict[int, tuple[str, str, str]] = field(default_factory=dict)
    """Topic, type and message encoding."""

    def take(self, opcode: int, payload: bytes | memoryview) -> None:
        if opcode == Opcode.SCHEMA:
            schema = parsed(Schema, payload)
            self.schemas[schema.id] = printable(schema.name)
        else:
            channel = parsed(Channel, payload)
            kind = ros2_type(self.schemas.get(channel.schema_id, ""))
            self.channels[channel.id] = (printable(channel.topic), kind, channel.message_encoding)


@dataclass(slots=True)
class Summary:
    """What the end of the file says of the rest."""

    start: int
    known: Channels
    chunk_starts: list[int]
    statistics: Statistics | None


def read_summary(stream: BinaryIO, size: int, problems: list[str]) -> Summary | None:
    """The summary, if the file has one and it is sound."""
    tail_bytes = _FOOTER_BYTES + len(MAGIC)
    if size < 2 * len(MAGIC) + _FOOTER_BYTES:
        return None
    stream.seek(size - tail_bytes)
    tail = stream.read(tail_bytes)
    if tail[_FOOTER_BYTES:] != MAGIC or HEAD.unpack_from(tail) != (Opcode.FOOTER, 20):
        note(problems, "the end of the file is missing or damaged: it was not closed, or was cut off")
        return None
    footer = parsed(Footer, tail[HEAD.size : _FOOTER_BYTES])
    if footer.summary_start == 0:
        return None
    length = size - tail_bytes - footer.summary_start
    damaged = "the summary at the end of the file is damaged; the messages are read without it"
    if footer.summary_start < len(MAGIC) or not 0 <= length <= MAX_SUMMARY_BYTES:
        note(problems, damaged)
        return None
    stream.seek(footer.summary_start)
    data = stream.read(length)
    if footer.summary_crc and zlib.crc32(tail[:25], zlib.crc32(data)) != footer.summary_crc:
        note(problems, damaged)
        return None
    summary = Summary(footer.summary_start, Channels(), [], None)
    try:
        for opcode, payload in split(data):
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                summary.known.take(opcode, payload)
            elif opcode == Opcode.STATISTICS:
                summary.statistics = parsed(Statistics, payload)
            elif opcode == Opcode.CHUNK_INDEX:
                summary.chunk_starts.append(parsed(ChunkIndex, payload).chunk_start_offset)
    except DamageError:
        note(problems, damaged)
        return None
    summary.chunk_starts.sort()
    return summary


def parsed(kind: Any, payload: bytes | memoryview) -> Any:
    """A record of the library's class `kind`; whatever it raises means damage."""
    try:
        return kind.read(ReadDataStream(BytesIO(payload)))
    except Exception as error:
        raise DamageError(0, f"{kind.__name__}: {one_line(error)}") from None


def split(data: bytes | memoryview) -> Iterator[tuple[int, memoryview]]:
    """The records in the content of a chunk or summary."""
    view = memoryview(data)
    offset = 0
    while offset < len(view):
        if offset + HEAD.size > len(view):
            raise DamageError(offset, "a record is cut off")
        opcode, length = HEAD.unpack_from(view, offset)
        offset += HEAD.size
        if length > len(view) - offset:
            raise DamageError(offset, "a record is longer than what holds it")
        yield opcode, view[offset : offset + length]
        offset += length
