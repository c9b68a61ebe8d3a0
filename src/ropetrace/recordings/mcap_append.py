"""An MCAP file that grows by whole chunks, so that a killed process loses nothing that was appended."""

from __future__ import annotations

import contextlib
import struct
import zlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from ropetrace.errors import OutputError
from ropetrace.recordings.mcap_parts import CHUNK, HEAD, MAGIC, MESSAGE
from ropetrace.recordings.ros_messages import RawMessage
from ropetrace.results.base import WholeFile, uninterrupted
from ropetrace.results.ros_estimates import typestore

COMPRESSION = "zstd"
_LEVEL = 1

LIBRARY = "ropetrace "
"""What the header of every file that is written here tells, before the version."""


@cache
def _library() -> str:
    return LIBRARY + version("ropetrace")


class McapAppender:
    """Appends messages to a new MCAP file, a compressed chunk with a checksum a call.

    What was in the file before is there until `begin`. When `append` returns the system has the chunk, and a kill
    cannot take it. The file can be read from the front at any time; `close` adds the index that other tools want, and
    `ropetrace.recordings.mcap_recover` adds it to a file that was never closed. Another process that would write to the
    file meanwhile is refused by a lock.

    Parameters
    ----------
    path : Path
        The file.
    overwrite : bool
        Whether it may exist.
    metadata : mapping of str to mapping
        Records of metadata, by their names.

    Raises
    ------
    OutputError
        If the file cannot be created or written, or another process writes to it.
    """

    def __init__(self, path: Path, overwrite: bool, metadata: Mapping[str, Mapping[str, str]]) -> None:
        self._index = McapIndex()
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._crc = 0
        self._broken = False
        self._closed = False
        self._start = MAGIC + packed(Header("ros2", _library()))
        for name, values in metadata.items():
            record = packed(Metadata(name=name, metadata=dict(values)))
            self._index.add_metadata(name, len(self._start), len(record))
            self._start += record
        self._file = WholeFile(path, overwrite)

    def begin(self) -> None:
        """Write the start of the file, in the place of what was in it; the first `append` does it where nobody did.

        Raises
        ------
        OutputError
            If the file cannot be written.
        """
        if not self._file.size:
            self._add(self._start)

    def append(self, messages: Sequence[RawMessage]) -> None:
        """Add messages as one chunk, wholly or not at all.

        Raises
        ------
        OutputError
            If the file cannot be written. Nothing more can be appended then.
        """
        self.begin()
        content = bytearray()
        entries: Entries = {}
        for message in messages:
            channel, introduction = self._index.channel(message)
            content += introduction
            entries.setdefault(channel, []).append((message.log_time_ns, len(content)))
            content += HEAD.pack(Opcode.MESSAGE, MESSAGE.size + len(message.data))
            sequence = self._index.counts[channel] + len(entries[channel]) - 1
            content += MESSAGE.pack(channel, sequence, message.log_time_ns, message.log_time_ns)
            content += message.data
        times = [message.log_time_ns for message in messages]
        body = self._compressor.compress(content)
        front = CHUNK.pack(min(times), max(times), len(content), zlib.crc32(content), len(COMPRESSION))
        length = len(front) + len(COMPRESSION) + 8 + len(body)
        chunk = ChunkRecord(self._file.size, HEAD.size + length, COMPRESSION, len(body), len(content))
        indexes = message_indexes(entries)
        with uninterrupted():
            self._add(
                HEAD.pack(Opcode.CHUNK, length)
                + front
                + COMPRESSION.encode()
                + struct.pack("<Q", len(body))
                + body
                + b"".join(indexes.values())
            )
            self._index.add_chunk(chunk, entries, indexes)

    def sync(self) -> None:
        """Have the disk take what was appended: from then on a power cut cannot take it either.

        Raises
        ------
        OutputError
            If the disk refuses.
        """
        self._file.sync()

    @property
    def size(self) -> int:
        """Bytes that were written."""
        return self._file.size

    def close(self) -> None:
        """Write the index and close the file; may be called again.

        Raises
        ------
        OutputError
            If the disk refuses; the file is then as a kill would have left it.
        """
        if self._closed:
            return
        self._closed = True
        try:
            # A full disk that refused a frame may well have room for the index.
            with uninterrupted(), contextlib.suppress(OutputError) if self._broken else contextlib.nullcontext():
                self.begin()
                self._file.append(self._index.ending(self._file.size, self._crc))
                self._file.sync()
        finally:
            self._file.close()

    def discard(self) -> None:
        """Close the file as if it had never been opened: a new one is removed, and one to which was appended too.

        Raises
        ------
        OutputError
            If it cannot be removed.
        """
        self._closed = True
        self._file.discard()

    def _add(self, data: bytes) -> None:
        if self._broken:
            raise OutputError("nothing can be appended to a file that could not be written")
        try:
            self._file.append(data)
        except OutputError:
            self._broken = True
            raise
        self._crc = zlib.crc32(data, self._crc)


Entries = dict[int, list[tuple[int, int]]]
"""For each channel the time of every message of a chunk, and its place in the content."""


@dataclass(frozen=True, slots=True)
class ChunkRecord:
    """Where a chunk lies in its file, and its sizes, bytes."""

    offset: int
    length: int
    compression: str
    compressed_size: int
    size: int


@dataclass(slots=True)
class McapIndex:
    """What the end of a file says of the rest, gathered as the file grows: about 200 bytes a chunk."""

    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    """Messages of each channel."""
    chunks: int = 0
    span: tuple[int, int] | None = None
    """Times of the first and the last message, nanoseconds."""
    metadata: int = 0
    _chunk_records: bytearray = field(default_factory=bytearray)
    _metadata_records: bytearray = field(default_factory=bytearray)

    def channel(self, message: RawMessage) -> tuple[int, bytes]:
        """The channel of a message, and the records that introduce it where it is new."""
        for known in self.channels.values():
            if known.topic == message.topic:
                return known.id, b""
        introduction = b""
        schema = next((schema for schema in self.schemas.values() if schema.name == message.type), None)
        if schema is None:
            schema = Schema(len(self.schemas) + 1, _definition(message.type), "ros2msg", message.type)
            self.schemas[schema.id] = schema
            introduction = packed(schema)
        channel = Channel(
            len(self.channels) + 1, message.topic, message.encoding, {"offered_qos_profiles": ""}, schema.id
        )
        self.channels[channel.id] = channel
        return channel.id, introduction + packed(channel)

    def add_metadata(self, name: str, offset: int, length: int) -> None:
        """Take note of a record of metadata."""
        self.metadata += 1
        self._metadata_records += packed(MetadataIndex(offset, length, name))

    def add_chunk(self, chunk: ChunkRecord, entries: Entries, indexes: Mapping[int, bytes]) -> None:
        """Take note of a chunk, and of the message indexes that follow it, as they are in the file."""
        times = [time for rows in entries.values() for time, _ in rows]
        offsets = {}
        offset = chunk.offset + chunk.length
        for channel, index in indexes.items():
            offsets[channel] = offset
            offset += len(index)
        first, last = min(times, default=0), max(times, default=0)
        record = ChunkIndex(
            chunk_length=chunk.length,
            chunk_start_offset=chunk.offset,
            compression=chunk.compression,
            compressed_size=chunk.compressed_size,
            message_end_time=last,
            message_index_length=offset - chunk.offset - chunk.length,
            message_index_offsets=offsets,
            message_start_time=first,
            uncompressed_size=chunk.size,
        )
        self._chunk_records += packed(record)
        self.chunks += 1
        for channel, rows in entries.items():
            self.counts[channel] += len(rows)
        if times:
            self.span = (first, last) if self.span is None else (min(first, self.span[0]), max(last, self.span[1]))

    def ending(self, offset: int, data_crc: int) -> bytes:
        """All that follows the data, which end at `offset` and have this checksum."""
        end = packed(DataEnd(data_crc))
        start = offset + len(end)
        statistics = Statistics(
            attachment_count=0,
            channel_count=len(self.channels),
            channel_message_counts=dict(self.counts),
            chunk_count=self.chunks,
            message_count=self.counts.total(),
            message_end_time=self.span[1] if self.span else 0,
            message_start_time=self.span[0] if self.span else 0,
            metadata_count=self.metadata,
            schema_count=len(self.schemas),
        )
        groups: dict[Opcode, bytes | bytearray] = {
            Opcode.SCHEMA: b"".join(map(packed, self.schemas.values())),
            Opcode.CHANNEL: b"".join(map(packed, self.channels.values())),
            Opcode.STATISTICS: packed(statistics),
            Opcode.CHUNK_INDEX: self._chunk_records,
            Opcode.METADATA_INDEX: self._metadata_records,
        }
        offsets, place, crc = b"", start, 0
        for opcode, group in groups.items():
            crc = zlib.crc32(group, crc)
            if group:
                offsets += packed(SummaryOffset(opcode, place, len(group)))
            place += len(group)
        footer = packed(Footer(start, place, 0))
        crc = zlib.crc32(footer[: -struct.calcsize("<I")], zlib.crc32(offsets, crc))
        # Joined once: after a day the chunks' records are a third of a gigabyte.
        return b"".join([end, *groups.values(), offsets, packed(Footer(start, place, crc)), MAGIC])


def packed(record: McapRecord) -> bytes:
    """A record as it is in a file."""
    builder: Any = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())


def message_indexes(entries: Entries) -> dict[int, bytes]:
    """The records that follow a chunk, by channel."""
    return {channel: packed(MessageIndex(channel, rows)) for channel, rows in entries.items()}


@cache
def _definition(kind: str) -> bytes:
    text, _ = typestore().generate_msgdef(kind, ros_version=2)
    return bytes(text.encode())
