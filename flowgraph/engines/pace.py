"""Whether the stamps of live events go on as fast as time does.

A sender that counts milliseconds and calls them nanoseconds makes ticks that are in order, and a `dt` that is
a million times too small: nothing is refused, and every answer is wrong.
"""

from __future__ import annotations

from flowgraph.data.notes import note

_UNITS = {"us": 1e-3, "ms": 1e-6, "s": 1e-9}
_WATCHED_S = 0.5
"""Over less of the wall's time nothing is said of a pace."""


class Pace:
    """Compares the stamps of ticks with when their events came."""

    def __init__(self) -> None:
        self._first: tuple[int, int] | None = None
        self._last = (0, 0)

    def tick(self, stamp: int, arrived: int) -> None:
        """A tick of an event that came at `arrived`; both in ns."""
        self._last = stamp, arrived
        if self._first is None:
            self._first = self._last

    def notes(self) -> list[str]:
        """What there is to say: stamps that are slow by a factor of a unit."""
        stamps, wall = (b - a for a, b in zip(self._first or self._last, self._last, strict=True))
        if wall < _WATCHED_S * 1e9:
            return []
        for unit, factor in _UNITS.items():
            if factor / 3.0 < stamps / wall < factor * 3.0:
                sentence = (
                    f"the stamps went on by {stamps} ns in {wall * 1e-9:.3g} s on the wall: are they {unit}?"
                )
                return [note("warning", f"{sentence} A stamp counts nanoseconds")]
        return []
