"""ROS 1 ``.bag`` files, read from the front: a bag that was cut off loses its index, not its messages.

Reading in the order of the file needs no index; the index tells the topics quickly, and how much was lost.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from ropetrace.errors import RecordingError
from ropetrace.recordings.base import note, printable
from ropetrace.recordings.decompress import DamageError, decompress
from ropetrace.recordings.ros_messages import MAX_MESSAGE_BYTES, RawMessage, Topic, ros2_type

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _BAG_HEADER, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 3, 4, 5, 6, 7
_MAX_HEADER_BYTES = 2**20
# The bit of an LZ4 frame's descriptor that says that a checksum follows the content.
_LZ4_CHECKSUM = 4


@dataclass(slots=True)
class _Record:
    offset: int
    fields: dict[bytes, bytes]
    data: bytes

    @property
    def kind(self) -> int:
        return self.fields.get(b"op", b"\0")[0] if self.fields.get(b"op") else 0

    def number(self, name: bytes, form: str = "<I") -> int:
        """A number of the header."""
        try:
            value: int = struct.unpack(form, self.fields[name])[0]
        except (KeyError, struct.error):
            raise DamageError(self.offset, f"a record lacks its field {name.decode()!r}") from None
        return value

    def text(self, name: bytes) -> str:
        """A text of the header."""
        return self.fields.get(name, b"").decode(errors="replace")


@dataclass(slots=True)
class _Pass:
    """The state of one pass over the file."""

    wanted: Collection[str] | None
    """The topics that are asked for; None for all."""
    connections: dict[int, tuple[str, str]] = field(default_factory=dict)
    """Topic and type; those of the index, where there is one, before any chunk is read."""
    seen: Counter[str] = field(default_factory=Counter)
    lossless: bool = True


class Ros1Bag:
    """Messages of a ``.bag`` file; see `ropetrace.recordings.ros_messages.MessageSource`.

    Raises
    ------
    RecordingError
        If the file cannot be opened, or is a bag of a kind that is not read.
    """

    kind = "ROS 1 bag"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        self.checksums = "none: altered bits within a message may go unnoticed"
        self._size = path.stat().st_size
        self._index_start: int | None = None
        self._counts: dict[str, Topic] | None = None
        self._connections: dict[int, tuple[str, str]] = {}
        try:
            with open(path, "rb") as stream:
                self._counts = self._read_index(stream)
        except DamageError as damage:
            note(
                self.problems,
                f"the index is missing or damaged ({damage.reason}): the bag is read without it",
            )

    def topics(self) -> dict[str, Topic]:
        """See `MessageSource.topics`; reads all of a file that lost its index."""
        if self._counts is not None:
            return self._counts
        current = _Pass(wanted=())
        for _ in self._walk(current):
            pass
        return {topic: Topic(kind, current.seen[topic]) for topic, kind in current.connections.values()}

    def messages(self, wanted: Collection[str] | None = None) -> Iterator[RawMessage]:
        """See `MessageSource.messages`."""
        # The chunk that introduces a connection may be lost.
        yield from self._walk(_Pass(wanted, dict(self._connections)))

    def _read_index(self, stream: BinaryIO) -> dict[str, Topic]:
        """The topics and their counts, from the end of the file."""
        stream.seek(len(MAGIC))
        header = _read(stream, len(MAGIC), self._size)
        if header.kind != _BAG_HEADER:
            raise DamageError(header.offset, "the bag's header is damaged")
        if header.text(b"encryptor"):
            raise RecordingError(f"{self.path}: the bag is encrypted; decrypt it first")
        start = header.number(b"index_pos", "<Q")
        if not len(MAGIC) < start <= self._size:
            raise DamageError(header.offset, "the recorder did not close the bag")
        stream.seek(start)
        current, counts, chunks, offset = _Pass(wanted=()), Counter[int](), 0, start
        while offset < self._size:
            record = _read(stream, offset, self._size)
            if record.kind == _CONNECTION:
                _connect(current, record)
            elif record.kind == _CHUNK_INFO:
                chunks += 1
                if len(record.data) != 8 * record.number(b"count"):
                    raise DamageError(offset, "an entry has the wrong length")
                for connection, count in struct.iter_unpack("<II", record.data):
                    counts[connection] += count
            else:
                raise DamageError(offset, f"a record of type {record.kind} is in it")
            offset = stream.tell()
        if (len(current.connections), chunks) != (
            header.number(b"conn_count"),
            header.number(b"chunk_count"),
        ):
            raise DamageError(start, "it is not as long as the header says")
        self._index_start, self._connections = start, current.connections
        totals: Counter[str] = Counter()
        for identity, (topic, _) in current.connections.items():
            totals[topic] += counts[identity]
        return {topic: Topic(kind, totals[topic]) for topic, kind in current.connections.values()}

    def _walk(self, current: _Pass) -> Iterator[RawMessage]:
        """Every message before the damage."""
        end = self._index_start or self._size
        offset = len(MAGIC)
        try:
            with open(self.path, "rb") as stream:
                stream.seek(offset)
                while offset < end:
                    record = _read(stream, offset, end)
                    offset = stream.tell()
                    if record.kind == _CHUNK:
                        yield from self._chunk(record, current)
                    elif record.kind in (_CONNECTION, _MESSAGE):
                        yield from self._take(record, record.offset, current)
                    elif record.kind not in (_BAG_HEADER, _INDEX, _CHUNK_INFO):
                        raise DamageError(record.offset, f"a record of the unknown type {record.kind}")
        except DamageError as damage:
            current.lossless = False
            note(self.problems, f"damaged at byte {damage.offset} ({damage.reason}): the rest is lost")
        except OSError as error:
            current.lossless = False
            note(self.problems, f"reading stopped: {error.strerror}")
        found = sum(current.seen.values())
        expected = sum(topic.count or 0 for topic in self._counts.values()) if self._counts is not None else None
        if expected is not None and expected != found:
            note(self.problems, f"{found} of the {expected} messages of the file were recovered")
        elif expected is None and not current.lossless:
            note(self.problems, f"{found} whole messages were recovered; how many there were is not known")

    def _chunk(self, chunk: _Record, current: _Pass) -> Iterator[RawMessage]:
        method = chunk.text(b"compression")
        try:
            data = decompress(method, chunk.data, chunk.number(b"size"), MAX_MESSAGE_BYTES)
        except DamageError as damage:
            current.lossless = False
            note(
                self.problems,
                f"the chunk at byte {chunk.offset} is damaged ({damage.reason}): its messages are lost",
            )
            return
        if method == "bz2" or (method == "lz4" and chunk.data[4] & _LZ4_CHECKSUM):
            self.checksums = f"a checksum within each {method} chunk"
        stream, offset = BytesIO(data), 0
        try:
            while offset < len(data):
                record = _read(stream, offset, len(data))
                offset = stream.tell()
                yield from self._take(record, chunk.offset, current)
        except DamageError as damage:
            current.lossless = False
            note(
                self.problems,
                f"the chunk at byte {chunk.offset} holds an unreadable record ({damage.reason}): cut there",
            )

    def _take(self, record: _Record, offset: int, current: _Pass) -> Iterator[RawMessage]:
        if record.kind == _CONNECTION:
            before = dict(current.connections)
            _connect(current, record)
            if any(current.connections[identity] != known for identity, known in before.items()):
                current.connections = before
                note(self.problems, f"the index and the chunk at byte {offset} disagree on a topic or its type")
            return
        if record.kind != _MESSAGE:
            raise DamageError(record.offset, f"a record of type {record.kind} is among the messages")
        connection = record.number(b"conn")
        if connection not in current.connections:
            note(
                self.problems,
                f"messages of the unknown connection {connection} are left out, the first at byte {offset}",
            )
            return
        topic, kind = current.connections[connection]
        current.seen[topic] += 1
        if current.wanted is None or topic in current.wanted:
            time = record.number(b"time", "<Q")  # seconds in the low half, nanoseconds in the high one
            yield RawMessage(topic, kind, "ros1", (time & 0xFFFFFFFF) * 10**9 + (time >> 32), record.data)


def _connect(current: _Pass, record: _Record) -> None:
    # The type stands in a second header, which is the record's data.
    details = _fields(record.data, record.offset)
    topic = printable(record.text(b"topic") or details.get(b"topic", b"").decode(errors="replace"))
    kind = ros2_type(printable(details.get(b"type", b"").decode(errors="replace")))
    current.connections[record.number(b"conn")] = (topic, kind)


def _read(stream: BinaryIO, offset: int, end: int) -> _Record:
    """The record at the stream's position, which is `offset`; nothing is read beyond `end`."""
    parts: list[bytes] = []
    position = offset
    for what, most in (("header", _MAX_HEADER_BYTES), ("record", MAX_MESSAGE_BYTES)):
        length_bytes = stream.read(4)
        position += 4
        if len(length_bytes) < 4 or position > end:
            raise DamageError(offset, f"the {what} is cut off")
        (length,) = struct.unpack("<I", length_bytes)
        if length > end - position:
            raise DamageError(offset, f"a {what} of {length} bytes reaches beyond the end")
        if length > most:
            raise DamageError(offset, f"a {what} declares {length} bytes, {most} are taken")
        parts.append(stream.read(length))
        position += length
    return _Record(offset, _fields(parts[0], offset), parts[1])


def _fields(header: bytes, offset: int) -> dict[bytes, bytes]:
    fields: dict[bytes, bytes] = {}
    position = 0
    while position < len(header):
        if position + 4 > len(header):
            raise DamageError(offset, "a header is cut off")
        (length,) = struct.unpack_from("<I", header, position)
        position += 4
        name, separator, value = header[position : position + length].partition(b"=")
        if length > len(header) - position or not separator:
            raise DamageError(offset, "a header holds no field where one must be")
        fields[name] = value
        position += length
    return fields
