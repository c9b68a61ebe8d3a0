"""rosbag2's SQLite files, ``.db3``: each row is read for itself, so that a damaged page costs few messages.

SQLite stores no checksums: a changed bit within a message cannot be noticed here.
"""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

import numpy as np

from ropetrace.errors import RecordingError
from ropetrace.recordings.base import note, one_line, printable
from ropetrace.recordings.ros_messages import MAX_MESSAGE_BYTES, RawMessage, Topic, ros2_type

MAGIC = b"SQLite format 3\0"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


class SqliteBag:
    """Messages of a ``.db3`` file; see `ropetrace.recordings.ros_messages.MessageSource`.

    Raises
    ------
    RecordingError
        If the file is not a rosbag2 database.
    """

    kind = "rosbag2 SQLite file"
    checksums = "none: SQLite has no checksums, so altered bits within a message may go unnoticed"

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        for ending in ("-wal", "-journal"):
            beside = Path(f"{path}{ending}")
            if beside.is_file() and beside.stat().st_size:
                note(
                    self.problems,
                    f"{beside.name} holds messages that were not merged into the file when the recorder "
                    f"died, and they are not read: run 'sqlite3 {path.name} .quit' on a copy of both "
                    "to merge them",
                )
        self._note_truncation()
        try:
            with closing(self._connect()) as database:
                self._check_tables(database)
                rows = database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
            self._topics = {
                int(identity): (
                    printable(str(name)),
                    ros2_type(printable(str(kind))),
                    "ros1" if encoding == "ros1" else str(encoding),
                )
                for identity, name, kind, encoding in rows
            }
        except (sqlite3.Error, ValueError, TypeError) as error:
            raise RecordingError(
                f"{path}: not a readable rosbag2 database ({one_line(error)}); its topics are lost"
            ) from None
        self._order, self._row_topics, self._times = self._index()

    def topics(self) -> dict[str, Topic]:
        """See `MessageSource.topics`."""
        counts: Counter[str] = Counter()
        for identity, count in zip(*np.unique(self._row_topics, return_counts=True), strict=True):
            if int(identity) in self._topics:
                counts[self._topics[int(identity)][0]] += int(count)
        return {name: Topic(kind, counts[name]) for name, kind, _ in self._topics.values()}

    def messages(self, wanted: Collection[str] | None = None) -> Iterator[RawMessage]:
        """See `MessageSource.messages`: in the order of their times of recording."""
        lost = 0
        try:
            with closing(self._connect()) as database:
                for row, identity, time in zip(self._order, self._row_topics, self._times, strict=True):
                    topic, kind, encoding = self._topics.get(int(identity), ("", "", ""))
                    if not topic or (wanted is not None and topic not in wanted):
                        continue
                    data = self._data(database, int(row))
                    if data is None:
                        lost += 1
                        continue
                    yield RawMessage(topic, kind, encoding, int(time), data)
        except sqlite3.Error as error:
            note(self.problems, f"reading stopped: {one_line(error)}")
        if lost:
            note(self.problems, f"{lost} messages lie on damaged pages and are lost")

    def _note_truncation(self) -> None:
        """Compare the length of the file with the count of pages in its header."""
        with open(self.path, "rb") as stream:
            head = stream.read(100)
        if len(head) < 100 or head[24:28] != head[92:96]:
            return  # the count is not kept by old versions of SQLite
        page, count = int.from_bytes(head[16:18], "big"), int.from_bytes(head[28:32], "big")
        declared, size = count * (65536 if page == 1 else page), self.path.stat().st_size
        if declared > size:
            note(self.problems, f"the file is cut off: {size} of {declared} bytes are there")

    def _connect(self) -> sqlite3.Connection:
        # Immutable: no lock, no journal, nothing beside the file is touched.
        database = sqlite3.connect(f"file:{quote(os.path.abspath(self.path))}?mode=ro&immutable=1", uri=True)
        database.text_factory = lambda text: text.decode(errors="replace")
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        database.execute("PRAGMA trusted_schema = OFF")
        # Else SQLite refuses all of a file that was cut off. It cannot write: the file is open read-only.
        database.execute("PRAGMA writable_schema = ON")
        return database

    def _check_tables(self, database: sqlite3.Connection) -> None:
        """Plain tables only: a view could compute for ever."""
        found = {
            str(name): str(sql)
            for name, sql in database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'")
        }
        for name in ("topics", "messages"):
            if not found.get(name, "").upper().startswith("CREATE TABLE"):
                raise RecordingError(
                    f"{self.path}: not a rosbag2 database: no table {name!r}; it holds "
                    f"{', '.join(sorted(found)) or 'no tables'}"
                )

    def _index(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Row, topic and time of every message that can be found, in the order of time."""
        rows: list[tuple[int, int, int]] = []
        with closing(self._connect()) as database:
            try:
                for row in database.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id"):
                    if all(isinstance(value, int) for value in row):
                        rows.append(row)
                    else:
                        note(self.problems, "rows without a time or topic are left out")
            except sqlite3.Error as error:
                note(
                    self.problems,
                    f"the table of messages is damaged ({one_line(error)}): {len(rows)} messages before were found",
                )
        table = np.array(rows, dtype=np.int64).reshape(-1, 3)
        table = table[np.argsort(table[:, 2], kind="stable")]
        return table[:, 0], table[:, 1], table[:, 2]

    def _data(self, database: sqlite3.Connection, row: int) -> bytes | None:
        try:
            found = database.execute("SELECT data FROM messages WHERE id = ?", (row,)).fetchone()
        except sqlite3.Error:
            return None
        data = found[0] if found else None
        if not isinstance(data, bytes):
            return None
        if data.startswith(_ZSTD_MAGIC):
            raise RecordingError(
                f"{self.path}: its messages are compressed one by one, which is not read: "
                "run 'ros2 bag convert' to an uncompressed bag first"
            )
        return data
