"""Parquet: a file a stream, a row a time, a column a number.

Columns are called as in `Series.to_pandas`, `position.x`; the first is `time`, int64 ns, and where values
came later than they were true, `stamp` is the second. Each column says its unit and frame in its metadata.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowgraph.data.export.packages import needed
from flowgraph.data.files import put
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


__all__ = ["write_parquet"]
