"""Recordings that are longer than memory, out of Parquet or CSV a piece at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.export.packages import needed
from flowgraph.data.series import Series
from flowgraph.errors import DataError, UnknownNameError
from flowgraph.language.checks import need_count

__all__ = ["read_pieces"]

FORMATS = {".csv": "csv", ".parquet": "parquet", ".feather": "feather", ".arrow": "arrow"}


def read_pieces(
    place: str | Path,
    signal: Any = None,
    *,
    time: str = "time",
    unit: str | None = None,
    columns: Mapping[str, str | Sequence[str]] | Sequence[str] | str | None = None,
    stamp: str | None = None,
    rows: int = 65_536,
    name: str | None = None,
) -> Iterator[Series]:
    """A stream of a recording, as `Series` one after the other, which a streamed run takes as a source.

    Args:
        place: a Parquet or CSV file; or a folder of Parquet files, as a streamed run writes for each stream,
            in the order of their names.
        signal, unit, columns: as `Series.from_pandas` takes them.
        time: the column of the stamps.
        stamp: the column, int64 ns, of when each value was true, where that was before `time`.
        rows: in a piece at most.
        name: for messages.

    Raises:
        DataError: for a place where there is nothing, or that is no such file.
        MissingDependencyError: without pyarrow or pandas.
        UnknownNameError: for a column that is not there, as of `Series.from_pandas`, when a piece is read.
    """
    need_count("read_pieces", "rows", rows, least=1)
    dataset = needed("pyarrow.dataset", "reading by pieces", "parquet")
    needed("pandas", "reading by pieces", "pandas")
    file = Path(place)
    called = name or file.stem
    try:
        found = dataset.dataset(file, format=FORMATS.get(file.suffix.lower(), "parquet"))
    except (OSError, ValueError) as error:
        raise DataError(
            "there is no table to read by pieces",
            path=str(file),
            expected="a file .parquet or .csv, or a folder of the first",
            got=f"{type(error).__name__}: {error}"[:200],
            fix="name another",
        ) from None

    def pieces() -> Iterator[Series]:
        batches = found.to_batches(batch_size=rows, batch_readahead=1, fragment_readahead=1)
        try:
            for batch in batches:
                frame = batch.to_pandas()
                if stamp is not None and stamp not in frame.columns:
                    raise UnknownNameError("column", stamp, map(str, frame.columns), path=called)
                more = {} if stamp is None else {"stamp": np.asarray(frame.pop(stamp))}
                if len(frame):
                    yield Series.from_pandas(
                        frame, signal, columns=columns, time=time, unit=unit, name=called, **more
                    )
        except (OSError, ValueError) as error:
            raise DataError(
                "a piece of this table cannot be read",
                path=str(file),
                expected="rows of numbers",
                got=f"{type(error).__name__}: {error}"[:200],
                fix="mend the file",
            ) from None

    return pieces()
