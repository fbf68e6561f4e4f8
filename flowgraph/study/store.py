"""Results on disk: one file a run, named by its key, that is either whole or not there; and the table of all.

A file is written under a temporary name in the same folder and then renamed, which the file system does at
once or not at all. It also carries a digest of its content, for a disk that lost power can leave a whole name
on half a file; what does not agree with its digest is no result, and is run again. It holds the digest of
its trajectory as well. The folder is locked while a study runs into it, and a second is refused.

    DIR/study.json               the resolved study
    DIR/study.lock               while it runs: which process on which machine
    DIR/results.parquet          a row a run
    DIR/runs/ab/abcd....json     one run
    DIR/trajectories/abcd....npz what a run estimated, where the study keeps it
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import arrays_of, claimed, content_of, put
from flowgraph.data.series import Series
from flowgraph.errors import DataError, MissingDependencyError, OutputError, writes
from flowgraph.study.keys import content_digest
from flowgraph.study.spec import MOST_RUNS, Study

RESULTS, RESOLVED, LOCK = "results.parquet", "study.json", "study.lock"
Row = dict[str, Any]

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


class Store:
    """The folder of one study's results.

    Args:
        folder: made where it is missing.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)

    def run_file(self, key: str) -> Path:
        return self.folder / "runs" / key[:2] / f"{key}.json"

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

    def read(self, key: str) -> Row | None:
        """The row of a run; None where there is none that is whole."""
        found = self._kept(key)
        return None if found is None else found["row"]

    def _kept(self, key: str) -> dict[str, Any] | None:
        try:
            found = json.loads(content_of(self.run_file(key)))
            row = found["row"]
            whole = found["key"] == key and found["digest"] == content_digest(row)
        except (OSError, ValueError, LookupError, TypeError, RecursionError):
            return None
        return found if whole and isinstance(row, dict) else None

    def write(self, key: str, row: Row, trajectory: bytes | None = None) -> None:
        """Keep a run: its trajectory first, so that a row never names one that is not there."""
        plain = json.loads(json.dumps(row))  # what is digested is what will be read
        content = {"key": key, "digest": content_digest(plain), "row": plain}
        if trajectory is not None:
            put_inside(self.trajectory_file(key), trajectory)
            content["trajectory"] = hashlib.sha256(trajectory).hexdigest()
        put_inside(self.run_file(key), json.dumps(content).encode())

    def has_trajectory(self, key: str) -> bool:
        """Whether the whole trajectory of this very run is there."""
        try:
            found = hashlib.sha256(content_of(self.trajectory_file(key), most=2**40)).hexdigest()
        except OSError:
            return False
        return (self._kept(key) or {}).get("trajectory") == found

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
            columns[name] = pyarrow.array(values, pyarrow.uint64())
        elif name in ("graph", "data", "error", "key") or kinds & {str} or (bool in kinds and len(kinds) > 1):
            texts = [None if v is None else str(v) for v in values]
            columns[name] = pyarrow.array(texts, pyarrow.string())
        elif kinds == {bool}:
            columns[name] = pyarrow.array(values, pyarrow.bool_())
        elif kinds == {int}:
            columns[name] = pyarrow.array(values, pyarrow.int64())
        else:
            numbers = [None if v is None else float(v) for v in values]
            columns[name] = pyarrow.array(numbers, pyarrow.float64())
    return pyarrow.table(columns)


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
