"""Bags in the containers that the `rosbags` library opens, told apart by what is in them, not by name.

A bag of ROS 1, a bare .mcap or .db3 of ROS 2, a folder with a metadata.yaml, and a folder with files of one
of these kinds, which are the parts of one recording. Messages are decoded by the definitions that ROS
publishes; those inside a bag are compared by their digest, and not run. Whatever the library says against a
file becomes a `DataError`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from heapq import merge
from pathlib import Path
from typing import Any

from flowgraph.errors import DataError, MissingDependencyError

__all__ = ["Bag"]

_MARKS = {b"#ROSBAG V": ".bag", b"\x89MCAP": ".mcap", b"SQLite format 3\x00": ".db3"}
"""How a file of each kind begins."""

_TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"
"""The definition of tf2_msgs/TFMessage and tf/tfMessage, which the library has for ROS 2 only."""


class Bag:
    """An open bag of either version.

    Args:
        path: a file or folder.

    Raises:
        MissingDependencyError: without the rosbags library.
        DataError: when it is no bag, or cannot be read.
    """

    def __init__(self, path: Path) -> None:
        try:
            from rosbags import rosbag1, rosbag2  # optional, with what follows
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise MissingDependencyError(
                "bags need the rosbags library",
                path=str(path),
                expected="the Python package rosbags",
                got="it cannot be imported",
                fix='pip install "flowgraph-filters[ros]"',
            ) from None
        self.path = path
        if path.is_dir() and (path / "metadata.yaml").exists():
            self.files, first = [path], False
            opened: list[Any] = [rosbag2.Reader]
        else:
            self.files, kinds = _files(path)
            first = kinds == {".bag"}
            plugins = rosbag2.Reader.STORAGE_PLUGINS
            opened = [rosbag1.Reader if first else plugins[str(_container(f))] for f in self.files]
        with self._damage():
            self.readers = [make(file) for make, file in zip(opened, self.files, strict=True)]
        self.store = get_typestore(Stores.ROS1_NOETIC if first else Stores.ROS2_HUMBLE)
        if first:
            for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
                self.store.register(get_types_from_msg(_TRANSFORMS, name))
        self.decode = self.store.deserialize_ros1 if first else self.store.deserialize_cdr
        self._digest = (lambda kind: self.store.generate_msgdef(kind)[1]) if first else self.store.hash_rihs01

    def __enter__(self) -> Bag:
        self._stack = ExitStack()
        try:
            with self._damage():
                for reader in self.readers:
                    reader.open()
                    self._stack.callback(reader.close)
                self.connections = [c for reader in self.readers for c in reader.connections]
                self._owners = [r for r in self.readers for _ in r.connections]
        except DataError:
            self._stack.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    def count(self, topic: str) -> int:
        """How many messages a topic has, as the bag says."""
        return sum(c.msgcount for c in self.connections if c.topic == topic)

    def messages(self, topic: str, kind: str) -> Iterator[tuple[int, Any]]:
        """Time of recording (ns) and message, of all messages of a topic that are of one type.

        Raises:
            DataError: naming the topic, for one that cannot be decoded, or of another definition.
        """
        with self._damage(topic):
            parts = []
            for reader in self.readers:
                mine = [
                    c
                    for c, owner in zip(self.connections, self._owners, strict=True)
                    if owner is reader and c.topic == topic and c.msgtype == kind
                ]
                for connection in mine:
                    self._known(connection)
                if mine:
                    parts.append(reader.messages(mine, None, None))
            for _, time, raw in merge(*parts, key=lambda found: found[1]):
                yield time, self.decode(raw, kind)

    def _known(self, connection: Any) -> None:
        """Refuse a message that is encoded or defined in another way than ROS publishes."""
        way = getattr(connection.ext, "serialization_format", "cdr")
        digest, ours = connection.digest, self._digest(connection.msgtype)
        if way != "cdr" or (digest not in ("", "*", None) and digest != ours):
            raise DataError(
                "these messages are not as ROS defines them",
                path=f"{self.path}: {connection.topic}",
                expected=f"{connection.msgtype} of digest {ours}",
                got=f"encoded as {way}" if way != "cdr" else f"digest {digest}",
                fix="record them with the definitions of ROS, or convert the bag",
            )

    @contextmanager
    def _damage(self, topic: str = "") -> Iterator[None]:
        """What the library says against a bag becomes a `DataError`."""
        try:
            yield
        except DataError:
            raise
        except Exception as error:
            raise DataError(
                "this bag cannot be read",
                path=f"{self.path}: {topic}" if topic else str(self.path),
                expected="a whole bag of ROS 1 or ROS 2",
                got=f"{type(error).__name__}: {error}"[:200],
                fix="fetch it again, or mend it with the tools of ROS (rosbag reindex, ros2 bag reindex)",
            ) from error


def _container(file: Path) -> str | None:
    """The kind of a file by how it begins; by its name, where it begins otherwise."""
    with file.open("rb") as stream:
        start = stream.read(16)
    for mark, kind in _MARKS.items():
        if start.startswith(mark):
            return kind
    return file.suffix.lower() if file.suffix.lower() in _MARKS.values() else None


def _files(path: Path) -> tuple[list[Path], set[str]]:
    """The files of a bag, and of what kinds they are: one of ROS 1, or those of ROS 2."""
    try:
        inside: Sequence[Path] = sorted(path.iterdir()) if path.is_dir() else [path]
        found = {f: kind for f in inside if f.is_file() and (kind := _container(f))}
    except OSError as error:
        raise _no_bag(path, str(error)) from error
    kinds = set(found.values())
    if not path.exists():
        raise _no_bag(path, "no such file or folder")
    if not found:
        names = ", ".join(f.name for f in inside[:8])
        raise _no_bag(path, f"a folder with {names or 'nothing in it'}" if path.is_dir() else path.name)
    if ".bag" in kinds and len(kinds) > 1:
        raise _no_bag(path, "files of ROS 1 and of ROS 2: " + ", ".join(f.name for f in found))
    return list(found), kinds


def _no_bag(path: Path, got: str) -> DataError:
    return DataError(
        "this is no bag",
        path=str(path),
        expected="a bag of ROS 1 (.bag), or of ROS 2 (.mcap, .db3, or a folder with them)",
        got=got,
        fix="check the path; what is compressed as a whole (.zst, .gz) is to be unpacked first",
    )
