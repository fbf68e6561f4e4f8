"""Parquet: a file a stream, a row a time, a column a number.

Columns are called as in `Series.to_pandas`, `position.x`; the first is `time`, int64 ns, and where values
came later than they were true, `stamp` is the second. Each column says its unit and frame in its metadata.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Self

from flowgraph.data.export.packages import needed
from flowgraph.data.files import put, whole
from flowgraph.data.frames import columns_of
from flowgraph.data.series import Series
from flowgraph.errors import writes
from flowgraph.types import leaves_of


def write_parquet(
    streams: Mapping[str, Series], folder: str | Path, *, about: Mapping[str, object] | None = None
) -> dict[str, Path]:
    """Write streams as Parquet, NAME.parquet each.

    Args:
        streams: by name.
        folder: for the files; made if missing.
        about: kept in each file as metadata.

    Returns:
        The files by stream.

    Raises:
        MissingDependencyError: without pyarrow.
        OutputError: where a file cannot be written.
    """
    arrow, parquet = (needed(p, "Parquet", "parquet") for p in ("pyarrow", "pyarrow.parquet"))
    target = Path(folder)
    with writes(target):
        target.mkdir(parents=True, exist_ok=True)
    said = {key: str(value) for key, value in (about or {}).items()}
    files = {}
    for name, series in streams.items():
        buffer = io.BytesIO()
        parquet.write_table(_table(arrow, series, said), buffer)
        files[name] = put(target / f"{name.replace('/', '.')}.parquet", buffer.getvalue())
    return files


class ParquetParts:
    """Files that grow by row groups: `NAME/part-00000.parquet` and on, of which each is whole or not there.

    Used as a context: what was added within it is one part of each stream. Where it ends with an error no
    part of it is there.

    Raises:
        MissingDependencyError: without pyarrow.
        OutputError: where a file cannot be written.
    """

    def __init__(self, folder: str | Path, number: int, about: Mapping[str, str]) -> None:
        self._arrow, self._parquet = (needed(p, "Parquet", "parquet") for p in ("pyarrow", "pyarrow.parquet"))
        self._folder, self._number, self._about = Path(folder), number, about
        self._open, self._closing = ExitStack(), ExitStack()
        self._writers: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def add(self, streams: Mapping[str, Series]) -> None:
        """One row group of each stream that has events."""
        for name, series in streams.items():
            table = _table(self._arrow, series, self._about)
            if name not in self._writers:
                file = self._open.enter_context(whole(part_file(self._folder, name, self._number)))
                writer = self._parquet.ParquetWriter(file, table.schema)
                self._closing.callback(writer.close)
                self._writers[name] = writer
            if len(series):
                self._writers[name].write_table(table)

    def __exit__(self, *error: Any) -> bool | None:
        if error[0] is None:
            with self._open:  # one that cannot be closed takes the others with it
                self._closing.close()
            return None
        with suppress(Exception):  # what ended the part is said, not what follows from it
            self._closing.close()
        return self._open.__exit__(*error)


def part_file(folder: str | Path, stream: str, number: int) -> Path:
    """The file of a part of a stream; its folder is made."""
    target = Path(folder) / stream.replace("/", ".")
    with writes(target):
        target.mkdir(parents=True, exist_ok=True)
    return target / f"part-{number:05}.parquet"


def _table(arrow: Any, series: Series, about: Mapping[str, str]) -> Any:
    own = {"time": series.time, **({"stamp": series.stamp} if series.is_late else {})}
    fields = [arrow.field(name, arrow.int64(), metadata={"unit": "ns"}) for name in own]
    arrays = [arrow.array(stamps) for stamps in own.values()]
    for leaf, type_ in leaves_of(series.type):
        part = columns_of({leaf: series.leaves[leaf]}, series.type)
        words = {k: v for k, v in (("unit", type_.unit), ("frame", type_.frame)) if v}
        for name, column in part.items():
            made = arrow.array(column)
            # A field that is called as our own column gets a line after its name: no column is there twice.
            fields.append(arrow.field(f"{name}_" if name in own else name, made.type, metadata=words))
            arrays.append(made)
    return arrow.table(arrays, schema=arrow.schema(fields, metadata=dict(about)))


__all__ = ["ParquetParts", "part_file", "write_parquet"]
