"""Whether the streams of a recording and its truth are of one time.

Each has a clock of its own in the worst case: header stamps of the epoch beside a motion capture that counts
from its start, a truth of another day. Streams that do not meet are refused, with by how much they are apart;
those that hardly do, or that look shifted as a whole, are named in a note.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from flowgraph.blocks.datasets.stamps import lasting, stretch
from flowgraph.data.joint import doubtful_span
from flowgraph.data.notes import note
from flowgraph.data.series import Series
from flowgraph.errors import DataError

__all__ = ["check_overlap"]

_SHIFTED = 10**9  # ns; both ends are apart by more than this, and by the same
_PART = 0.5


def check_overlap(
    place: str,
    streams: Mapping[str, Series],
    truth: Series | None,
    fix: Callable[[str, str, float], str],
    got: Callable[[str, str], str],
) -> list[str]:
    """Notes on streams that hardly overlap with the first inertial one, or with the first there is.

    Args:
        place: the recording.
        streams: by name.
        truth: perhaps.
        fix: of the two names and the seconds that would bring the starts together.
        got: of the two names, what else is to be said.

    Raises:
        DataError: where one has no sample within the other's span.
    """
    held = {**streams, **({"truth": truth} if truth is not None else {})}
    held = {name: series for name, series in held.items() if len(series)}
    inertial = [name for name, series in held.items() if "specific_force" in series.leaves]
    if len(held) < 2:
        return []
    one = inertial[0] if inertial else next(iter(held))
    a = held[one].time
    said = []
    for name, series in held.items():
        if name == one:
            continue
        b = series.time
        inside = int(np.searchsorted(b, a[-1], side="right") - np.searchsorted(b, a[0]))
        around = int(np.searchsorted(a, b[-1], side="right") - np.searchsorted(a, b[0]))
        start, end = int(b[0]) - int(a[0]), int(b[-1]) - int(a[-1])
        if (not inside and name != "truth") or (not inside and not around):
            gap = max(int(b[0]) - int(a[-1]), int(a[0]) - int(b[-1]), 0)
            raise DataError(
                f"no sample of {name} lies within the span of the {one}",
                path=f"{place}: {name}",
                expected=f"stamps from {a[0]} to {a[-1]} ns ({lasting(a)})",
                got=f"{b[0]} to {b[-1]} ns ({lasting(b)}), {stretch(gap)} apart" + got(name, one),
                fix=fix(name, one, -start / 1e9),
            )
        share = max(inside / len(b), around / len(a))
        length = max(int(a[-1]) - int(a[0]), int(b[-1]) - int(b[0]))
        doubtful = doubtful_span(name, b, one, a)
        if doubtful and share >= _PART:
            said += doubtful
        elif share < _PART:
            said.append(
                note("warning", f"{name}: only {inside} of {len(b)} samples lie within the span of the {one}")
            )
        elif (
            start * end > 0
            and min(abs(start), abs(end)) > _SHIFTED
            and abs(start - end) < 0.1 * abs(start)
            and abs(start) > 0.01 * length
        ):
            way = "later" if start > 0 else "earlier"
            sentence = f"{name} starts and ends {stretch(start)} {way} than {one}: if their clocks differ, "
            said.append(
                note("warning", f"{sentence}{name}.time_offset={-start / 1e9:.3g} brings them together")
            )
    return said
