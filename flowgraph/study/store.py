"""Results on disk: a line a run, written as it ends, and the table of all.

Lines are only ever added, so what is killed leaves all but its last line whole. Each carries a digest of its
row; what does not agree with it is no result, and is run again. It holds the digest of its trajectory as
well. Of two lines of one run the later counts. Other files are written under a temporary name and then
renamed, which the file system does at once or not at all. The folder is locked while a study runs into it,
and a second is refused.

    DIR/study.json               the resolved study
    DIR/study.lock               while it runs: which process on which machine
    DIR/runs.jsonl               a run that has ended a line
    DIR/results.parquet          a row a run
    DIR/trajectories/abcd....npz what a run estimated, where the study keeps it
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import socket
import stat
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import arrays_of, claimed, content_of, put
from flowgraph.data.series import Series
from flowgraph.errors import DataError, MissingDependencyError, OutputError, writes
from flowgraph.study.keys import content_digest
from flowgraph.study.spec import MOST_RUNS, Study

RESULTS, RESOLVED, LOCK, RUNS = "results.parquet", "study.json", "study.lock", "runs.jsonl"
Row = dict[str, Any]

MOST_LINE = 2**24
"""Bytes of the longest line of a run that is read."""

MOST_KEPT = 2**33
"""Bytes of the largest trajectory that is read."""


def import_pyarrow() -> Any:
    """The `pyarrow` module.

    Raises:
        MissingDependencyError: with what to install.
    """
    try:
        import pyarrow  # optional, with what follows
        import pyarrow.parquet
    except ImportError as error:
        raise MissingDependencyError(
            "the table of a study needs pyarrow",
            path="flowgraph.study",
            expected="an installed pyarrow",
            got=str(error),
            fix='pip install "flowgraph-filters[study]"',
        ) from None
    return pyarrow


def put_inside(file: Path, content: bytes) -> None:
    """Put a whole file in place, or leave what was there; its folder is made where it is missing.

    It does not wait for the disk: of many small files that takes long, and what is half has another digest.
    """
    with writes(file):
        file.parent.mkdir(parents=True, exist_ok=True)
    put(file, content, lasting=False)


def is_key(text: Any) -> bool:
    """Whether it is the key of a run, which names files: nothing else in a table leads to one."""
    return isinstance(text, str) and re.fullmatch("[0-9a-f]{16,128}", text) is not None


@dataclass(frozen=True)
class Kept:
    """A run that was kept: its row, and the digest of its trajectory where it has one."""

    key: str
    row: Row
    trajectory: str | None = None


def _kept(line: bytes) -> Kept | None:
    """The run of a line; None where it is not whole."""
    try:
        found = json.loads(line)
        key, row = found["key"], found["row"]
        whole = is_key(key) and isinstance(row, dict) and found["digest"] == content_digest(row)
        return Kept(key, row, found.get("trajectory")) if whole else None
    except (ValueError, LookupError, TypeError, RecursionError):
        return None


def _waiting_for_nobody(file: str, flags: int) -> int:
    """Open a file; a pipe in its place has nobody at its other end, and is not waited for."""
    return os.open(file, flags | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0), 0o666)


class Store:
    """The folder of one study's results.

    Args:
        folder: made where it is missing.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def trajectory_file(self, key: str) -> Path:
        return self.folder / "trajectories" / f"{key}.npz"

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Hold the folder for one study, so that what is in it is of one.

        Raises:
            OutputError: where another process has it, or it cannot be written.
        """
        with writes(self.folder):
            self.folder.mkdir(parents=True, exist_ok=True)
        ours = f"process {os.getpid()} on {socket.gethostname()}"
        with claimed(self.folder / LOCK, by=ours) as holder:
            if holder is not None:
                raise OutputError(
                    "another study is running into this folder",
                    path=str(self.folder),
                    expected="a folder for this study alone",
                    got=f"{LOCK} is held by {holder}",
                    fix="wait until it ends, or choose another folder",
                )
            yield

    def read(self, keys: Iterable[str]) -> dict[str, Kept]:
        """What there is, whole, of the runs of these keys."""
        wanted, found = set(keys), {}
        with suppress(OSError), open(self.folder / RUNS, "rb", opener=_waiting_for_nobody) as stream:
            while stat.S_ISREG(os.fstat(stream.fileno()).st_mode) and (line := stream.readline(MOST_LINE)):
                kept = _kept(line)
                if kept is not None and kept.key in wanted:
                    found[kept.key] = kept
        return found

    def write(self, runs: Iterable[tuple[str, Row, bytes | None]]) -> None:
        """Keep runs, each with its key and perhaps its trajectory, which comes first, so that no row names
        one that is not there.

        Raises:
            OutputError: where they cannot be written.
        """
        lines = []
        for key, row, trajectory in runs:
            plain = json.loads(json.dumps(row))  # what is digested is what will be read
            content = {"key": key, "digest": content_digest(plain), "row": plain}
            if trajectory is not None:
                put_inside(self.trajectory_file(key), trajectory)
                content["trajectory"] = hashlib.sha256(trajectory).hexdigest()
            lines.append(json.dumps(content).encode() + b"\n")
        file = self.folder / RUNS
        with writes(file), open(file, "ab+", buffering=0, opener=_waiting_for_nobody) as stream:
            size = stream.seek(0, os.SEEK_END)
            torn = size > 0 and os.pread(stream.fileno(), 1, size - 1) != b"\n"
            left = memoryview(b"\n" * torn + b"".join(lines))
            while left:
                left = left[stream.write(left) :]

    def has_trajectory(self, kept: Kept) -> bool:
        """Whether the whole trajectory of this very run is there."""
        try:
            content = content_of(self.trajectory_file(kept.key), most=2**40)
        except OSError:
            return False
        return hashlib.sha256(content).hexdigest() == kept.trajectory

    def write_study(self, resolved: Mapping[str, Any]) -> None:
        """Keep the resolved study; a file of that name that is none is somebody else's.

        Raises:
            OutputError: where it is, or it cannot be written.
        """
        file = self.folder / RESOLVED
        if os.path.lexists(file):
            try:
                found = json.loads(content_of(file))
            except (OSError, ValueError, RecursionError):
                found = None
            if not isinstance(found, dict) or not {"graphs", "data"} <= set(found):
                raise OutputError(
                    "another file is already here",
                    path=str(file),
                    expected="the folder of a study, or an empty one",
                    got=f"a {RESOLVED} that is no study",
                    fix="choose another folder, or remove the file first",
                )
        put_inside(file, (json.dumps(resolved, indent=1) + "\n").encode())

    def write_table(self, rows: Sequence[Row], first: Iterable[str] = ()) -> Path:
        """The table of all rows as Parquet, in the order of `rows`; columns in `first` come first."""
        pyarrow = import_pyarrow()
        file = self.folder / RESULTS
        sink = pyarrow.BufferOutputStream()
        pyarrow.parquet.write_table(as_table(rows, first), sink)
        put_inside(file, sink.getvalue().to_pybytes())
        return file


def read_table(folder: str | Path) -> list[Row]:
    """The rows of a study's table, in order.

    Raises:
        DataError: where there is none.
    """
    pyarrow = import_pyarrow()
    file = Path(folder)
    file = file / RESULTS if file.is_dir() else file
    try:
        whole = pyarrow.BufferReader(content_of(file))
        held = pyarrow.parquet.ParquetFile(whole)
        _check_table(held)
        found: list[Row] = held.read().to_pylist()
    except (OSError, ValueError, OverflowError, MemoryError, pyarrow.ArrowException) as error:
        raise DataError(
            "no results can be read here",
            path=str(file),
            expected=f"a folder with {RESULTS}, which `flowgraph batch` writes",
            got=f"{type(error).__name__}: {error}"[:300],
            fix="run the study first: flowgraph batch STUDY.toml --out DIR",
        ) from None
    return found


def _check_table(held: Any) -> None:
    """Refuse what is no table of runs, or one that would take more memory than runs can.

    Raises:
        ValueError: saying how it is not.
    """
    absent = {"graph", "data", "seed", "key"} - set(held.schema_arrow.names)
    if absent:
        raise ValueError(f"no column {', '.join(sorted(absent))}")
    schema = held.schema_arrow
    texts = [schema.field(n).type for n in ("graph", "data", "key")]
    if any(str(t) != "string" for t in texts) or any(f.type.num_fields for f in schema):
        raise ValueError("columns of other types than a study's")
    rows, columns = held.metadata.num_rows, held.metadata.num_columns
    if not 0 <= rows <= MOST_RUNS or columns > 2**14:
        raise ValueError(f"{rows} rows of {columns} columns")


def read_study(folder: str | Path) -> Study:
    """The resolved study of a folder of results.

    Raises:
        DataError: where there is none.
    """
    return Study.load(Path(folder) / RESOLVED, checked=False)


def as_table(rows: Sequence[Row], first: Iterable[str] = ()) -> Any:
    """A pyarrow table with one type a column: numbers stay numbers, and a mixture becomes text."""
    pyarrow = import_pyarrow()
    every = dict.fromkeys([*first, *(n for row in rows for n in row)])
    late = [n for n in every if n == "error" or n.endswith("_s") or n == "key"]
    names = [n for n in every if n not in late]
    names += sorted(late, key=lambda n: (n != "error", n == "key"))
    columns = {}
    for name in names:
        values = [row.get(name) for row in rows]
        kinds = {type(v) for v in values if v is not None}
        if name == "seed":
            columns[name] = _column(values, np.uint64)
        elif name in ("graph", "data", "error", "key") or kinds & {str} or (bool in kinds and len(kinds) > 1):
            columns[name] = _text_column([None if v is None else str(v) for v in values])
        elif kinds <= {bool} and kinds:
            columns[name] = _column(values, np.bool_)
        else:
            columns[name] = _column(values, np.int64 if kinds == {int} else np.float64)
    return pyarrow.table(columns)


def _column(values: Sequence[Any], kind: Any) -> Any:
    """Numbers or truths, with gaps for None, put together by hand: `pyarrow.array` would load pandas, which
    takes as long as some hundred runs."""
    pyarrow = import_pyarrow()
    array = np.array([0 if v is None else v for v in values], kind)
    held = _bits(array) if array.dtype == np.bool_ else array
    type_ = pyarrow.from_numpy_dtype(array.dtype)
    return pyarrow.Array.from_buffers(type_, len(array), [_there(values), pyarrow.py_buffer(held)])


def _text_column(values: Sequence[str | None]) -> Any:
    pyarrow = import_pyarrow()
    texts = [b"" if v is None else v.encode() for v in values]
    ends = np.array([0, *accumulate(map(len, texts))], np.int32)  # raises where it is more than 2 GiB
    held = [_there(values), pyarrow.py_buffer(ends), pyarrow.py_buffer(b"".join(texts))]
    return pyarrow.Array.from_buffers(pyarrow.string(), len(texts), held)


def _there(values: Sequence[Any]) -> Any:
    """Which of the values are no gaps; None where all are."""
    there = np.array([v is not None for v in values], bool)
    return None if there.all() else import_pyarrow().py_buffer(_bits(there))


def _bits(truths: np.ndarray) -> np.ndarray:
    return np.packbits(truths, bitorder="little")


def pack_trajectory(series: Mapping[str, Series]) -> bytes:
    """Streams as the bytes of an `.npz`: `NAME/time` in ns and an array a leaf, `NAME/LEAF`."""
    arrays = {}
    for name, one in series.items():
        arrays[f"{name}/time"] = one.time
        arrays.update({f"{name}/{leaf}": array for leaf, array in one.leaves.items()})
    sink = io.BytesIO()
    np.savez_compressed(sink, allow_pickle=False, **arrays)
    return sink.getvalue()


def read_trajectory(file: str | Path) -> dict[str, dict[str, np.ndarray]]:
    """The streams that a run kept: by name, their `time` (ns) and leaves.

    Raises:
        DataError: where the file is missing, damaged, or no trajectory.
    """
    found: dict[str, dict[str, np.ndarray]] = {}
    try:
        for name, array in arrays_of(file, most=MOST_KEPT).items():
            stream, slash, leaf = name.partition("/")
            if not slash:
                raise ValueError(f"{name[:60]!r} is no field of a stream")
            found.setdefault(stream, {})[leaf] = array
    except (OSError, ValueError) as error:
        raise DataError(
            "no trajectory can be read here",
            path=str(file),
            expected="a file of the trajectories that `flowgraph batch --keep` writes",
            got=f"{type(error).__name__}: {error}"[:300],
            fix="run the study again, which replaces what is damaged",
        ) from None
    return found
