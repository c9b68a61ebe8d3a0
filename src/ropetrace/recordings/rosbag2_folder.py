"""rosbag2 folders: the files of one recording, one after the other."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from pathlib import Path

from ropetrace.errors import FrameError, RecordingError
from ropetrace.recordings.base import MAX_TEXT_BYTES, natural_key, note, read_file
from ropetrace.recordings.ros_messages import MessageSource, RawMessage, Topic


class Rosbag2Folder:
    """Messages of a folder of ``.mcap`` or ``.db3`` files; see `ros_messages.MessageSource`.

    ``metadata.yaml`` may be missing: the files say everything themselves. Where it is there, its count of
    messages tells how many were lost.

    Raises
    ------
    RecordingError
        If there is no file, or files of both kinds, or none can be opened.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: list[str] = []
        files = sorted(
            (file for file in path.iterdir() if file.suffix in (".mcap", ".db3")),
            key=lambda file: natural_key(file.name),
        )
        kinds = {file.suffix for file in files}
        if len(kinds) != 1:
            raise RecordingError(f"{path}: holds both .mcap and .db3 files: give the one file that is meant")
        self.kind = f"rosbag2 folder ({kinds.pop()})"
        self._files: list[MessageSource] = []
        for file in files:
            try:
                self._files.append(open_ros_file(file))
            except (RecordingError, OSError) as error:
                note(self.problems, f"{file.name} is lost: {error}")
        if not self._files:
            raise RecordingError(f"{path}: none of its {len(files)} files can be read: {self.problems[0]}")
        self._gather()

    @property
    def checksums(self) -> str:
        """What protects the content."""
        return self._files[0].checksums

    def topics(self) -> dict[str, Topic]:
        """See `MessageSource.topics`."""
        topics: dict[str, Topic] = {}
        for file in self._files:
            for name, topic in file.topics().items():
                before = topics.get(name)
                known = before is None or before.count is not None
                count = (
                    topic.count + (before.count or 0 if before else 0) if known and topic.count is not None else None
                )
                topics[name] = Topic(topic.type, count)
        self._gather()
        return topics

    def messages(self, wanted: Collection[str] | None = None) -> Iterator[RawMessage]:
        """See `MessageSource.messages`."""
        found = 0
        for file in self._files:
            for message in file.messages(wanted):
                found += 1
                yield message
            self._gather()
        expected = self._expected()
        if wanted is None and expected is not None and found != expected:
            note(self.problems, f"{found} of the {expected} messages that metadata.yaml counts were recovered")

    def _expected(self) -> int | None:
        """The count of all messages in metadata.yaml, if it is there and says so."""
        try:
            text = read_file(self.path / "metadata.yaml", MAX_TEXT_BYTES).decode(errors="replace")
        except FrameError:
            return None
        # One number of a file that rosbag2 writes: no need to let YAML's aliases and tags in.
        match = re.search(r"^  message_count: ([0-9]{1,18})\s*$", text, re.MULTILINE)
        return int(match[1]) if match else None

    def _gather(self) -> None:
        """The problems of the files, with their names."""
        for file in self._files:
            for problem in file.problems:
                note(self.problems, f"{file.path.name}: {problem}")


def open_ros_file(path: Path) -> MessageSource:
    """Open one file of ROS messages, recognised by its first bytes, else by its suffix.

    Raises
    ------
    RecordingError
        If it is empty or none.
    """
    with open(path, "rb") as stream:
        head = stream.read(16)
    if not head:
        raise RecordingError(f"{path}: the file is empty (0 bytes)")
    if path.suffix.lower() == ".mcap" or head.startswith(b"\x89MCAP"):
        from ropetrace.recordings.mcap_source import McapFile

        return McapFile(path)
    if path.suffix.lower() == ".db3" or head.startswith(b"SQLite format 3"):
        from ropetrace.recordings.sqlite_bag import SqliteBag

        return SqliteBag(path)
    from ropetrace.recordings.ros1_bag import MAGIC, Ros1Bag

    if head.startswith(b"#ROSBAG V") and not head.startswith(MAGIC):
        raise RecordingError(
            f"{path}: a ROS 1 bag of version {head[8:13].decode(errors='replace')!r}; only 2.0 is read: "
            "run 'rosbag migrate' or 'rosbag reindex' on it"
        )
    return Ros1Bag(path)
