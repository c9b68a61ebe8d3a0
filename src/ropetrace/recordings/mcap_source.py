"""MCAP files, read from the front with every checksum verified, whatever damage comes.

The library's own readers load what a damaged length declares, decompress without a bound, and give up on a
truncated file; only its record classes are used.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from ropetrace.recordings.base import note
from ropetrace.recordings.decompress import DamageError, decompress
from ropetrace.recordings.mcap_parts import CHUNK, HEAD, MAGIC, MESSAGE, Channels, read_summary, split
from ropetrace.recordings.ros_messages import MAX_MESSAGE_BYTES, RawMessage, Topic

_DATA_SECTION = {
    Opcode.HEADER,
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.MESSAGE,
    Opcode.CHUNK,
    Opcode.MESSAGE_INDEX,
    Opcode.ATTACHMENT,
    Opcode.METADATA,
    Opcode.DATA_END,
}


@dataclass(slots=True)
class _Pass:
    """The state of one pass over the file."""

    wanted: Collection[str] | None
    """The topics that are asked for; None for all."""
    known: Channels = field(default_factory=Channels)
    seen: Counter[str] = field(default_factory=Counter)
    data_crc: int | None = 0
    """None once a part was skipped."""
    unprotected: int = 0
    """Messages that no chunk's checksum covers."""
    lossless: bool = True


class McapFile:
    """Messages of an MCAP file; see `ropetrace.recordings.ros_messages.MessageSource`.

    Raises
    ------
    RecordingError
        If the file cannot be opened.
    """

    kind = "MCAP"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        self.checksums = "not known before all of it was read"
        self._size = path.stat().st_size
        with open(path, "rb") as stream:
            self._summary = read_summary(stream, self._size, self.problems)

    def topics(self) -> dict[str, Topic]:
        """See `MessageSource.topics`; reads all of a file that lost its summary."""
        if self._summary is not None and self._summary.statistics is not None:
            counts: Counter[str] = Counter()
            for identity, count in self._summary.statistics.channel_message_counts.items():
                if identity in self._summary.known.channels:
                    counts[self._summary.known.channels[identity][0]] += count
            return {topic: Topic(kind, counts[topic]) for topic, kind, _ in self._summary.known.channels.values()}
        current = _Pass(wanted=())
        for _ in self._walk(current):
            pass
        return {topic: Topic(kind, current.seen[topic]) for topic, kind, _ in current.known.channels.values()}

    def messages(self, wanted: Collection[str] | None = None) -> Iterator[RawMessage]:
        """See `MessageSource.messages`."""
        yield from self._walk(_Pass(wanted))

    def _walk(self, current: _Pass) -> Iterator[RawMessage]:
        """Every message before the damage, and after it where the summary tells where to go on."""
        if self._summary is not None:
            # The chunk that introduces a channel may be lost.
            current.known.schemas |= self._summary.known.schemas
            current.known.channels |= self._summary.known.channels
        try:
            with open(self.path, "rb") as stream:
                offset = 0
                while True:
                    try:
                        yield from self._read_from(stream, offset, current)
                        break
                    except DamageError as damage:
                        current.data_crc = None
                        current.lossless = False
                        # Go on at the next chunk that the summary knows of; no other position can be trusted.
                        starts = self._summary.chunk_starts if self._summary else []
                        found = next((start for start in starts if start > damage.offset), None)
                        rest = "the rest is lost" if found is None else f"read on at byte {found}"
                        note(self.problems, f"damaged at byte {damage.offset} ({damage.reason}): {rest}")
                        if found is None:
                            break
                        offset = found
        except OSError as error:
            note(self.problems, f"reading stopped: {error.strerror}")
        self._conclude(current)

    def _read_from(self, stream: BinaryIO, offset: int, current: _Pass) -> Iterator[RawMessage]:
        """The messages from a record's offset on; raises DamageError where there is no whole record."""
        end = self._summary.start if self._summary else self._size
        chunk_starts = set(self._summary.chunk_starts) if self._summary else set()
        stream.seek(offset)
        if offset == 0:
            magic = stream.read(len(MAGIC))
            current.data_crc = zlib.crc32(magic)
            if magic != MAGIC:
                note(self.problems, "the mark at the start of the file is damaged")
            offset = len(magic)
        while True:
            head = stream.read(HEAD.size)
            if len(head) < HEAD.size:
                raise DamageError(offset, "the file ends here, without an end marker")
            opcode, length = HEAD.unpack(head)
            if length > end - offset - HEAD.size:
                raise DamageError(offset, f"a record of {length} bytes reaches beyond the end")
            if opcode not in _DATA_SECTION and opcode < 0x80:
                raise DamageError(offset, f"a record of type {opcode} does not belong here")
            if offset in chunk_starts and opcode != Opcode.CHUNK:
                raise DamageError(offset, f"a record of type {opcode} is where a chunk must be")
            if opcode == Opcode.DATA_END:
                self._check_end(stream.read(length), offset, current)
                return
            payload = self._payload(stream, head, offset, current)
            if opcode == Opcode.CHUNK:
                yield from self._chunk(payload, offset, current)
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                try:
                    current.known.take(opcode, payload)
                except DamageError as damage:
                    note(self.problems, f"an unreadable record at byte {offset} ({damage.reason}) is left out")
            elif opcode == Opcode.MESSAGE:
                current.unprotected += 1
                yield from self._message(payload, offset, current)
            offset += HEAD.size + length

    @staticmethod
    def _payload(stream: BinaryIO, head: bytes, offset: int, current: _Pass) -> bytes:
        """The bytes of a record; those that nobody needs go by in blocks, for the checksum only."""
        opcode, length = HEAD.unpack(head)
        needed = opcode in (Opcode.CHUNK, Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL)
        if needed and length > MAX_MESSAGE_BYTES:
            raise DamageError(offset, f"a record declares {length} bytes, {MAX_MESSAGE_BYTES} are taken")
        crc = zlib.crc32(head, current.data_crc or 0)
        payload, left = b"", length
        while left:
            payload = stream.read(left if needed else min(left, 2**20))
            if not payload:
                raise DamageError(offset, "the file ends within a record")
            crc = zlib.crc32(payload, crc)
            left -= len(payload)
            if needed and left:
                raise DamageError(offset, "the file ends within a record")
        if current.data_crc is not None:
            current.data_crc = crc
        return payload

    def _chunk(self, payload: bytes, offset: int, current: _Pass) -> Iterator[RawMessage]:
        """The messages of a chunk, if its checksum fits."""
        try:
            _, _, size, crc, name_bytes = CHUNK.unpack_from(payload)
            data_start = CHUNK.size + name_bytes + 8
            (data_bytes,) = struct.unpack_from("<Q", payload, data_start - 8)
        except struct.error:
            raise DamageError(offset, "a chunk is too short") from None
        if data_start + data_bytes != len(payload):
            raise DamageError(offset, "the lengths in a chunk do not fit")
        try:
            name = payload[CHUNK.size : data_start - 8].decode(errors="replace")
            data = decompress(name, memoryview(payload)[data_start:], size, MAX_MESSAGE_BYTES)
            if crc and zlib.crc32(data) != crc:
                raise DamageError(offset, "wrong checksum")
        except DamageError as damage:
            current.lossless = False
            current.data_crc = None
            note(
                self.problems,
                f"the chunk at byte {offset} is damaged ({damage.reason}): its messages are lost",
            )
            return
        try:
            for opcode, record in split(data):
                if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                    current.known.take(opcode, record)
                elif opcode == Opcode.MESSAGE:
                    current.unprotected += not crc
                    yield from self._message(record, offset, current)
        except DamageError as damage:
            note(
                self.problems,
                f"the chunk at byte {offset} holds an unreadable record ({damage.reason}): cut there",
            )

    def _message(self, record: bytes | memoryview, offset: int, current: _Pass) -> Iterator[RawMessage]:
        if len(record) < MESSAGE.size:
            note(self.problems, f"a message at byte {offset} is too short and is left out")
            return
        channel, _, log_time, _ = MESSAGE.unpack_from(record)
        known = current.known.channels.get(channel)
        if known is None:
            note(
                self.problems,
                f"messages of the unknown channel {channel} are left out, the first at byte {offset}",
            )
            return
        topic, kind, encoding = known
        current.seen[topic] += 1
        if current.wanted is None or topic in current.wanted:
            yield RawMessage(topic, kind, encoding, log_time, memoryview(record)[MESSAGE.size :])

    def _check_end(self, payload: bytes, offset: int, current: _Pass) -> None:
        if len(payload) != 4:
            raise DamageError(offset, "the end marker of the data has the wrong length")
        if self._summary is not None and offset + HEAD.size + 4 != self._summary.start:
            raise DamageError(offset, "the data end before the summary begins")
        (crc,) = struct.unpack("<I", payload)
        if current.unprotected:
            self.checksums = "one CRC over all of the file" if crc else "none: altered bits may go unnoticed"
        else:
            self.checksums = "a CRC over each chunk, and one over the file" if crc else "a CRC over each chunk"
        if not crc or current.data_crc in (None, crc):
            return
        if current.unprotected:
            note(
                self.problems,
                f"the checksum over the file is wrong: at least one of its {current.unprotected} messages "
                "without a checksum of their own may be altered, and which one cannot be told",
            )
        else:
            note(
                self.problems,
                "the checksum over the file is wrong, though every chunk passed its own: "
                "something outside the chunks was altered",
            )

    def _conclude(self, current: _Pass) -> None:
        """State the loss."""
        found = sum(current.seen.values())
        expected = self._summary.statistics.message_count if self._summary and self._summary.statistics else None
        if expected is not None and expected != found:
            note(self.problems, f"{found} of the {expected} messages of the file were recovered")
        elif expected is None and not current.lossless:
            note(self.problems, f"{found} whole messages were recovered; how many there were is not known")
