"""Number formats for a graph: found on some flights, widened until nothing saturates, judged on others.

The sizes of all values are taken from flights in floating point and widened by a margin. Each width of words
is then tried in integers, on the flights of the sizes first: what saturates there is rounding that floating
point does not have, and its format is widened. The flights that were held out judge: against the same filter
in float64, in the terms of the filter. The search goes down from the width that was given while the bounds
hold. Where they do not, some values may have wider words: those whose rounding moves most what is judged, and
of them the fewest that keep the bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from time import process_time
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.engines.c.fixed import CompiledIntegers
from flowgraph.engines.contract import Outcome
from flowgraph.engines.fixed.abreast import Recorded
from flowgraph.engines.fixed.counts import KINDS, Counts, names_of
from flowgraph.engines.fixed.ranges import Sizes
from flowgraph.engines.options import RunOptions
from flowgraph.engines.simulate import simulate
from flowgraph.engines.subject import LoweredGraph
from flowgraph.errors import DeclarationError, LoweringError, UnknownNameError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.format_files import structure_of
from flowgraph.pipeline.formats import NARROWEST, WIDEST, Formats
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.plain import plain
from flowgraph.recorder.random import seed_words
from flowgraph.study.differences import FIGURES, differences
from flowgraph.study.widening import fewest, most_needed, wide_words, with_own
from flowgraph.types import unflatten

MARGIN = 2.0
"""The sizes that occurred times this fit their formats, if nobody says otherwise."""

_ROUNDS = 30
_WIDER, _WIDEST, _HOPELESS = 2, 16, 128
"""Bits by which the format of what saturates is widened: twice as many each time that it happens again."""

Say = Callable[[str], None]


@dataclass(frozen=True)
class Flown:
    """A graph made ready for a flight, and what it is fed; `estimate` names its output that is judged."""

    graph: Graph
    inputs: Inputs
    estimate: str
    seed: int = 0


@dataclass(frozen=True)
class Quantised:
    """Formats, and what they are worth.

    Args:
        formats: of the narrowest words that keep the bounds.
        figures: of the flights that were held out, the worst of each, with saturations and the other counts.
        tried: the figures of each width, widest first.
        notes: what was widened, a sentence each.
    """

    formats: Formats
    figures: Mapping[str, Any]
    tried: tuple[Mapping[str, Any], ...]
    notes: tuple[str, ...]
    pipeline: Pipeline

    def values(self) -> list[dict[str, Any]]:
        """For a person: each value that is no move with its line, bits, the fractions of its elements, and
        whether its size is proven or was observed."""
        names = names_of(self.pipeline)
        return [
            {
                "value": n,
                "name": names.get(n, f"v{n}"),
                "bits": self.formats.width_of(n),
                "fraction": [int(np.min(f)), int(np.max(f))],
                "bound": "proven" if n in self.formats.proven else "observed",
            }
            for n in with_own(self.pipeline, self.formats)
            for f in [self.formats.fractions[n]]
        ]


def quantise(
    flights: Sequence[Flown],
    held_out: Sequence[Flown],
    *,
    width: int = 32,
    bounds: Mapping[str, float],
    margin: float = MARGIN,
    least: int = NARROWEST,
    held_width: int = 0,
    widen: int = 0,
    say: Say = lambda words: None,
) -> Quantised:
    """The narrowest words, of `width` bits at most, in which a graph keeps the bounds.

    Args:
        flights: on which formats are found; one is a trap, for another flies elsewhere.
        held_out: on which they are judged.
        width: bits of a word at most.
        bounds: figures of `FIGURES`, and the most that each may be.
        margin: the sizes that occurred times this fit.
        least: bits below which nothing is tried.
        held_width: bits of inputs, registers and what is added up in them, where they are more.
        widen: bits of as few other values as keep the bounds, where `width` does not keep them for all.
        say: told what is going on.

    Raises:
        LoweringError: where the graph does not keep the bounds even at `width`, naming the place; or has no
            form in fixed point.
        DeclarationError, UnknownNameError: for flights or bounds that do not fit.
    """
    for name in bounds:
        if name not in FIGURES:
            raise UnknownNameError("bound", name, FIGURES, path="--bound")
    if not flights or not held_out:
        raise DeclarationError(
            "formats are found on some flights and judged on others",
            path="quantise",
            expected="one flight at least of each",
            got=f"{len(flights)} and {len(held_out)} held out",
            fix="write --seeds 4 --held-out-seeds 3",
        )
    Formats(width, {}, wider={0: held_width} if held_width else {})  # refuses words that there are not
    if not NARROWEST <= least <= width:
        raise DeclarationError(
            "no width can be tried",
            path="--least",
            expected=f"{NARROWEST} to {width} bits",
            got=str(least),
            fix="ask for fewer bits at least, or for more at most (--width)",
        )
    if widen and not width < widen <= WIDEST:
        raise DeclarationError(
            "values cannot be widened to this",
            path="--widen",
            expected=f"{width + 1} to {WIDEST} bits" if width < WIDEST else f"--width less than {WIDEST}",
            got=str(widen),
            fix="allow the others fewer bits (--width), or leave --widen out: a product reads no wider words",
        )
    search = _Search(flights, held_out, margin, say, held_width)
    tried: list[Mapping[str, Any]] = []
    best: tuple[Formats, Mapping[str, Any]] | None = None
    bits, step = width, 2
    while bits >= least:
        formats, figures = search.at(bits)
        if widen and not keeps(figures, bounds):
            formats, figures = search.mixed(bits, widen, bounds)
        holds = keeps(figures, bounds)
        tried.append({**figures, "holds": holds})
        say(f"{bits} bits: {'holds' if holds else 'does not hold'}, " + _said(figures))
        if holds:
            best = formats, figures
            bits -= step
        elif best is None:
            raise search.refusal(bits, figures, bounds)
        elif step == 2:
            bits, step = bits + 1, least + width  # the one between, and then no more
            if bits >= best[0].width:
                break
        else:
            break
    assert best is not None
    return Quantised(best[0], best[1], tuple(tried), tuple(search.notes), search.pipeline)


def keeps(figures: Mapping[str, Any], bounds: Mapping[str, float]) -> bool:
    """Whether nothing saturates, and no bound is broken."""
    return not figures["saturations"] and all(figures[k] <= v for k, v in bounds.items())


def _said(figures: Mapping[str, Any]) -> str:
    return ", ".join(f"{k} {v:.3g}" for k, v in figures.items() if not k.endswith("bits") or k == "lost_bits")


class _Search:
    def __init__(
        self, flights: Sequence[Flown], held_out: Sequence[Flown], margin: float, say: Say, held_width: int
    ) -> None:
        self._held_width = held_width
        self._flights = [_Ready(f) for f in flights]
        self._held = [_Ready(f) for f in held_out]
        self._margin, self._say = margin, say
        self.pipeline = self._flights[0].pipeline
        self.notes: list[str] = []
        self._more: dict[int, int] = {}
        self._wider: dict[int, int] = {}
        self._worst = Counts()
        self._joined = False
        first = structure_of(self.pipeline)
        for one in (*self._flights, *self._held):
            if structure_of(one.pipeline) != first:
                raise DeclarationError(
                    "these flights make different filters of the graph",
                    path=one.flown.graph.name,
                    expected="one structure, with the same settings and streams",
                    got="another",
                    fix="quantise them one by one",
                )
        self.sizes = Sizes(self.pipeline)
        self._observe(self._flights)

    def _observe(self, flights: Sequence[_Ready]) -> None:
        """Take the sizes of some flights, all at once."""
        start, ticks = process_time(), self.sizes.ticks
        self.sizes.play([f.recorded for f in flights])
        took = f"{self.sizes.ticks - ticks} ticks in {process_time() - start:.2f} s of a processor"
        self._say(f"sizes of {len(flights)} flight{'s' * (len(flights) > 1)}: {took}")

    def at(self, bits: int) -> tuple[Formats, dict[str, Any]]:
        """Formats of so many bits, and their figures on the flights that were held out.

        Each width begins with the sizes in floating point: what another had to widen says nothing of it.
        """
        self._forget()
        formats, player = self._settled(bits)
        figures = self._judge(formats, player)
        if figures["saturations"] and not self._joined:
            self._join(bits)
            self._forget()
            formats, player = self._settled(bits)
            figures = self._judge(formats, player)
        for _ in range(_ROUNDS):
            if not figures["saturations"] or not self._widen(self._worst, "flights held out", bits):
                break
            formats = self._formats(bits)
            figures = self._judge(formats, self._player(formats))
        return formats, figures

    def _forget(self) -> None:
        self.sizes.forget()
        self._more.clear()
        self._wider.clear()

    def _formats(self, bits: int) -> Formats:
        return self.sizes.formats(bits, self._margin, self._held_width, self._wider)

    def mixed(self, bits: int, widen: int, bounds: Mapping[str, float]) -> tuple[Formats, dict[str, Any]]:
        """Formats of so many bits in which as few values as a bisection finds have wider words, after `at`;
        and their figures.

        Those come first whose rounding moves most what is judged, on the first of the flights of the sizes.
        """
        one = self._flights[0]
        port = [p.name for p in self.pipeline.outputs].index(one.flown.estimate)
        order = most_needed(one.recorded, self._formats(bits), port, set(bounds))
        self._say(f"{len(order)} values by what their rounding does")

        def tried(count: int) -> tuple[Formats, dict[str, Any]]:
            self._wider = dict.fromkeys(order[:count], widen)
            formats = self._formats(bits)
            figures = self._judge(formats, self._player(formats)) | {"wide_bits": widen, "wide_values": count}
            said = "holds" if keeps(figures, bounds) else "does not hold"
            self._say(f"{count} of {widen} bits beside {bits}: {said}, " + _said(figures))
            return formats, figures

        formats, figures = fewest(len(order), tried, lambda made: keeps(made[1], bounds))
        self._wider = dict.fromkeys(order[: figures["wide_values"]], widen)
        self.notes.append(wide_words(self.pipeline, formats, self._wider))
        self._say(self.notes[-1])
        return formats, figures

    def _settled(self, bits: int) -> tuple[Formats, _Fleet]:
        """Formats in which nothing saturates on the flights of the sizes."""
        for _ in range(_ROUNDS):
            formats = self._formats(bits)
            player = self._player(formats)
            if not self._widened(player, self._flights, "the flights of the sizes", bits):
                break
        return formats, player

    def _join(self, bits: int) -> None:
        """Take the sizes of the flights held out as well, in floating point: after a first word that is cut a
        filter may go anywhere, and what its integers would have needed there tells nothing."""
        self._joined = True
        names = names_of(self.pipeline)
        some = ", ".join(names[v] for v in list(self._worst.cut)[:3])
        self.notes.append(
            f"the flights held out are larger than those of the sizes, which were too few, and their sizes"
            f" were joined: {len(self._worst.cut)} values were cut at {bits} bits, as {some}"
        )
        self._say(self.notes[-1])
        self._observe(self._held)

    def _player(self, formats: Formats) -> _Fleet:
        patterns = sorted({key for one in (*self._flights, *self._held) for key in one.tape.patterns})
        return _Fleet(formats, patterns)

    def _widened(self, player: _Fleet, flights: Sequence[_Ready], where: str, bits: int) -> bool:
        counts = Counts()
        for one in flights:
            counts.join(one.play(player.of(one)))
        return self._widen(counts, where, bits)

    def _widen(self, counts: Counts, where: str, bits: int) -> bool:
        """Widen the formats of what saturated; tells whether anything was, and whether that may help.

        A quotient by zero fits no word, nor does a filter that has gone astray: what was widened by
        `_WIDEST` again and again will always saturate.
        """
        cut = {n: marks for n, marks in counts.cut.items() if n not in counts.divisions_by_zero}
        if not cut or any(self._more.get(n, 0) >= _HOPELESS for n in cut):
            return False
        for value, marks in cut.items():
            more = self._more[value] = 2 * self._more.get(value, _WIDER // 2)
            self.sizes.widen(value, marks, 2.0 ** min(more, _WIDEST))
        names = names_of(self.pipeline)
        some = ", ".join(names[v] for v in list(cut)[:3])
        self.notes.append(f"{len(cut)} values widened at {bits} bits, after {where}: {some}")
        self._say(self.notes[-1])
        return True

    def _judge(self, formats: Formats, player: _Fleet) -> dict[str, Any]:
        self._worst = Counts()
        held = max(self._held_width, formats.width)
        found: dict[str, Any] = {"bits": formats.width, "held_bits": held}
        found |= dict.fromkeys(KINDS, 0)
        for one in self._held:
            counts = one.play(player.of(one))
            self._worst.join(counts)
            for name, figure in differences(one.reference, one.result(), one.flown.estimate).items():
                found[name] = max(found.get(name, 0), figure)
        found |= {kind: self._worst.total(kind) for kind in KINDS}
        return found

    def refusal(self, bits: int, figures: Mapping[str, Any], bounds: Mapping[str, float]) -> LoweringError:
        """Why the graph is not trusted at so many bits, with the place."""
        broken = {k: v for k, v in bounds.items() if not figures[k] <= v}
        kind = next((k for k in ("saturations", "divisions_by_zero") if self._worst.total(k)), None)
        named = self._worst.first(self.pipeline, kind) if kind else self._coarsest(bits)
        place = f"; most {kind} in {named}" if kind else f"; coarsest beside its size: {named}"
        return LoweringError(
            f"this graph cannot be trusted at {bits} bits",
            path=named,
            expected=", ".join(f"{k} <= {v:g}" for k, v in broken.items()) or "no saturation",
            got=_said(figures) + place,
            fix="allow more bits (--width), a larger bound, or write the place so that its numbers are nearer"
            " to one another",
        )

    def _coarsest(self, bits: int) -> str:
        """The register whose elements differ most in size: its words are the first to be too short."""
        names = names_of(self.pipeline)
        spread: dict[int, float] = {}
        for register in self.pipeline.registers:
            for c in register.cells:
                size = self.sizes.largest.get(c.read)
                if size is not None and (size > 0.0).any():
                    spread[c.read] = float(size.max() / size[size > 0.0].min())
        return names[max(spread, key=lambda n: spread[n])] if spread else self.pipeline.name


class _Fleet:
    """The filter in its formats for any flight. Constants are those of the flight, as where it starts level;
    the compiled text is the same for all."""

    def __init__(self, formats: Formats, patterns: Sequence[int]) -> None:
        self._formats, self._patterns = formats, patterns
        self._made: dict[bytes, CompiledIntegers] = {}

    def of(self, one: _Ready) -> CompiledIntegers:
        """The player for a flight."""
        numbers = b"".join(a.tobytes() for _, a in sorted(one.pipeline.constants.items()))
        if numbers not in self._made:
            pipeline = replace(one.pipeline, formats=self._formats)
            self._made[numbers] = CompiledIntegers(pipeline, self._patterns, tabled=True)
        return self._made[numbers]


class _Ready:
    """A flight as ticks, with what the filter makes of it in float64."""

    def __init__(self, flown: Flown) -> None:
        self.flown = flown
        subject = LoweredGraph(flown.graph, dtype="fixed")
        if lower(flown.graph).host:
            raise LoweringError(
                "a graph with blocks on the host has no formats",
                path=flown.graph.name,
                expected="a graph that lowers whole",
                got=", ".join(stage.path for stage in lower(flown.graph).host),
                fix="quantise the graph without them",
            )
        self.pipeline = plain(subject.pipeline)
        self.start = subject.start(RunOptions(seed=flown.seed))
        self.tape = subject.tape(flown.inputs, self.start.last)
        self.seed = seed_words(flown.seed)
        self._subject = subject
        self._reference: Result | None = None
        self._outcome: Outcome | None = None

    @property
    def recorded(self) -> Recorded:
        """What is played abreast of others."""
        return Recorded(self.pipeline, self.tape, self.start.cells, self.seed)

    @property
    def reference(self) -> Result:
        """In float64."""
        if self._reference is None:
            self._reference = simulate(
                self.flown.graph, self.flown.inputs, engine="reference", seed=self.flown.seed
            )
        return self._reference

    def play(self, player: CompiledIntegers) -> Counts:
        """Fly in integers; gives what was counted."""
        self._outcome = player.play(self.tape, self.start.cells, self.seed, None)
        return player.counts

    def result(self) -> dict[str, Series]:
        """The outputs of the last flight."""
        assert self._outcome is not None
        return {
            port.name: Series(times, unflatten(type_, iter(leaves)), type=type_, name=port.name)
            for port, type_, (times, leaves) in zip(
                self.pipeline.outputs, self._subject.types, self._outcome.outputs, strict=True
            )
        }
