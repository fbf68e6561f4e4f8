"""How commands speak: results to standard output, the rest to standard error, errors as an exit status."""

from __future__ import annotations

import functools
import json
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TextIO

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.markup import escape
from rich.segment import Segment
from rich.table import Table

from flowgraph.data.registry import installed
from flowgraph.errors import DeclarationError, FlowgraphError, UnknownNameError, plain, writes

_PLAIN = str.maketrans({
    **dict.fromkeys("│┃╎", "|"), **dict.fromkeys("─━╌", "-"), **dict.fromkeys("├└╰╭┌┐┘┤┬┴┼╮╯", "+"),
    "▷": ">", "◁": "<", "▪": "*", "●": "o", "…": "...", "≤": "<=", "≥": ">=", "×": "x", "·": ".", "→": "->",
    "±": "+-", "°": "deg", "²": "2", "³": "3", "σ": "sigma", "–": "-", "—": "-", "µ": "u", "−": "-",
})  # fmt: skip
"""What stands for a character of ours where a terminal has not got it."""


def in_characters_of(stream: TextIO | None, text: str) -> str:
    """The text in characters that the stream can write: a terminal may be cp1252, cp437 or ASCII."""
    encoding = getattr(stream, "encoding", None) or "utf-8"
    try:
        text.encode(encoding)
    except UnicodeEncodeError:
        return text.translate(_PLAIN).encode(encoding, "replace").decode(encoding)
    return text


class PlainConsole(Console):
    """A console on which what comes from a file is text, steers no terminal, and can be written on it."""

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
                continue
            text = segment.text if segment.text.isprintable() else plain(segment.text)
            yield Segment(in_characters_of(self.file, text), segment.style)  # type: ignore[arg-type]


out_console = PlainConsole(soft_wrap=True, emoji=False)
err_console = PlainConsole(stderr=True, soft_wrap=True, highlight=False, emoji=False)


def give_up(message: str) -> None:
    """Say why, and let nothing more be written to standard output, which may be what has failed."""
    with suppress(OSError):
        err_console.print(f"error: {message}", markup=False)
    with suppress(OSError, ValueError):  # ValueError: it is no file, as in tests
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


class Terminated(KeyboardInterrupt):
    """SIGTERM, which ends a command as Ctrl-C does: with what is done kept, and nothing left running."""


@contextmanager
def terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM is raised as `Terminated`; where it cannot be (in a thread), it is left as it is."""

    def raised(*_: object) -> None:
        raise Terminated

    try:
        before = signal.signal(signal.SIGTERM, raised)
    except ValueError:
        yield
        return
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)


def reports_errors(command: Callable[..., None]) -> Callable[..., None]:
    """Errors of this package become a message on standard error and an exit status."""

    @functools.wraps(command)
    def run(*args: Any, **options: Any) -> None:
        try:
            with terminated_as_interrupted():
                command(*args, **options)
            sys.stdout.flush()
        except Terminated:
            raise typer.Exit(128 + signal.SIGTERM) from None
        except FlowgraphError as error:
            err_console.print(f"error: {error}", markup=False)
            raise typer.Exit(2 if isinstance(error, UnknownNameError | DeclarationError) else 1) from None
        except BrokenPipeError:
            raise typer.Exit(1) from None
        except OSError as error:
            give_up(f"{type(error).__name__}: {error}")
            raise typer.Exit(1) from None
        except MemoryError as error:
            give_up(f"there is not enough memory for this: {error}")
            raise typer.Exit(1) from None

    return run


def offered(group: str) -> dict[str, Any]:
    """What installed packages offer in a group, by name; what cannot be imported is named with its reason."""
    found, failed = installed(group)
    for error in failed:
        err_console.print(
            f"warning: {error.path}: {error.message}: {error.expected}: {error.got}", markup=False
        )
    return found


def make_ready(folder: Path) -> None:
    """Make a folder for results, and see that files can be made in it, before time is spent."""
    with writes(folder):
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()


@contextmanager
def writing(file: Path) -> Iterator[Path]:
    """Say what is written, and whether something was there before."""
    before = file.exists()
    with writes(file):
        yield file
    err_console.print(f"{'replaced' if before else 'wrote'} {file}", markup=False)


def first_line(doc: str) -> str:
    return doc.strip().partition("\n")[0].rstrip(".")


def print_json(value: Any) -> None:
    print(json.dumps(value, indent=1, allow_nan=False))


_WORDS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "position_rmse_m": ("position RMSE [mm]", lambda v: f"{1e3 * v:.2f}"),
    "attitude_rmse_deg": ("attitude [deg]", lambda v: f"{v:.3f}"),
    "tilt_rmse_deg": ("tilt [deg]", lambda v: f"{v:.3f}"),
    "heading_rmse_deg": ("heading [deg]", lambda v: f"{v:.3f}"),
    "position_3sigma": ("position in 3 sigma", lambda v: f"{100 * v:.1f} %"),
    "tilt_3sigma": ("tilt in 3 sigma", lambda v: f"{100 * v:.1f} %"),
    "wall_s": ("time [s]", lambda v: f"{v:.2f}"),
    "setup_s": ("set-up [s]", lambda v: f"{v:.2f}"),
}
_HIDDEN = ("graph", "engine", "compared_ticks", "heading_3sigma")


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """A column a key, for lists."""
    keys = list(dict.fromkeys(k for row in rows for k in row))
    table = Table(*keys, box=None, pad_edge=False)
    for row in rows:
        table.add_row(*(_short(row.get(key)) for key in keys))
    return table


def print_whole(shown: Table) -> None:
    """Print a table of figures with all its columns, wider than the terminal if it must be."""
    options = out_console.options.update(width=10_000)
    wide = max(out_console.width, out_console.measure(shown, options=options).maximum)
    PlainConsole(file=out_console.file, width=wide).print(shown, crop=False, no_wrap=True)


def _short(value: Any) -> str:
    return "" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def runs_table(rows: list[dict[str, Any]]) -> Table:
    """A column a run and a line a measure, so that it fits a terminal."""
    table = Table(box=None, pad_edge=False)
    table.add_column("")
    for row in rows:
        table.add_column(f"{row['graph']}\n{row['engine']}", justify="right")
    for key in dict.fromkeys(k for row in rows for k in row if k not in _HIDDEN):
        label = _WORDS[key][0] if key in _WORDS else key
        table.add_row(escape(label), *(_cell(key, row[key]) if key in row else "" for row in rows))
    return table


def _cell(key: str, value: Any) -> str:
    if key in _WORDS and value is not None:
        return _WORDS[key][1](value)
    return f"{value:g}" if isinstance(value, float) else str(value)
