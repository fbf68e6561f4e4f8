"""Results on disk: one file a run, named by its key, that is either whole or not there; and the table of all.

A file is written under a temporary name in the same folder and then renamed, which the file system does at
once or not at all. It also carries a digest of its content, for a disk that lost power can leave a whole name
on half a file; what does not agree with its digest is no result, and is run again.

    DIR/study.json               the resolved study
    DIR/results.parquet          a row a run
    DIR/runs/ab/abcd....json     one run
    DIR/trajectories/abcd....npz what a run estimated, where the study keeps it
"""

from __future__ import annotations

import io
import json
import os
import secrets
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.series import Series
from flowgraph.errors import DataError, MissingDependencyError, writes
from flowgraph.study.keys import content_digest
from flowgraph.study.spec import Study

RESULTS, RESOLVED = "results.parquet", "study.json"
Row = dict[str, Any]


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


def write_atomically(file: Path, content: bytes) -> None:
    """Put a whole file in place, or leave what was there."""
    with writes(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_name(f".{secrets.token_hex(8)}.part")
        try:
            with open(temporary, "xb") as stream:  # not of `tempfile`, whose files nobody else may read
                stream.write(content)
            os.replace(temporary, file)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


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

    def read(self, key: str) -> Row | None:
        """The row of a run; None where there is none that is whole."""
        try:
            found = json.loads(self.run_file(key).read_bytes())
            row = found["row"]
            whole = found["key"] == key and found["digest"] == content_digest(row)
        except (OSError, ValueError, KeyError, TypeError):
            return None
        return row if whole and isinstance(row, dict) else None

    def write(self, key: str, row: Row, trajectory: bytes | None = None) -> None:
        """Keep a run: its trajectory first, so that a row never names one that is not there."""
        if trajectory is not None:
            write_atomically(self.trajectory_file(key), trajectory)
        plain = json.loads(json.dumps(row))  # what is digested is what will be read
        content = {"key": key, "digest": content_digest(plain), "row": plain}
        write_atomically(self.run_file(key), json.dumps(content, indent=1).encode())

    def has_trajectory(self, key: str) -> bool:
        return self.trajectory_file(key).exists()

    def write_study(self, resolved: Mapping[str, Any]) -> None:
        write_atomically(self.folder / RESOLVED, (json.dumps(resolved, indent=1) + "\n").encode())

    def write_table(self, rows: Sequence[Row], first: Iterable[str] = ()) -> Path:
        """The table of all rows as Parquet, in the order of `rows`; columns in `first` come first."""
        pyarrow = import_pyarrow()
        file = self.folder / RESULTS
        sink = pyarrow.BufferOutputStream()
        pyarrow.parquet.write_table(as_table(rows, first), sink)
        write_atomically(file, sink.getvalue().to_pybytes())
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
        found: list[Row] = pyarrow.parquet.read_table(file, partitioning=None).to_pylist()
    except (OSError, pyarrow.ArrowException) as error:
        raise DataError(
            "no results can be read here",
            path=str(file),
            expected=f"a folder with {RESULTS}, which `flowgraph batch` writes",
            got=f"{type(error).__name__}: {error}",
            fix="run the study first: flowgraph batch STUDY.toml --out DIR",
        ) from None
    return found


def read_study(folder: str | Path) -> Study:
    """The resolved study of a folder of results.

    Raises:
        DataError: where there is none.
    """
    return Study.load(Path(folder) / RESOLVED)


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
    """The streams that a run kept: by name, their `time` (ns) and leaves."""
    found: dict[str, dict[str, np.ndarray]] = {}
    with np.load(file, allow_pickle=False) as arrays:
        for name in arrays.files:
            stream, _, leaf = name.partition("/")
            found.setdefault(stream, {})[leaf] = arrays[name]
    return found
