"""The dialects that tables are written in: from a text file to its names, units and cells, line by line.

pandas, R, MATLAB, spreadsheets and loggers write the same numbers in many ways. What a file uses is found
here, once for all loaders: its encoding, marks of comments, delimiter, quotes, rows of names and of units. A
file that is no text, or whose columns cannot be told, is refused by the name of what it is. What was found
out, and not said by anyone, is a note.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from flowgraph.blocks.datasets.cells import BLANKS, is_datum
from flowgraph.blocks.datasets.units import split_unit, unit_of
from flowgraph.data.notes import note
from flowgraph.errors import DataError, UnknownNameError

__all__ = ["DELIMITERS", "Sheet", "lines_of", "read_sheet", "text_of"]

DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "pipe": "|", "space": None}
"""What may stand between cells; None is any white space."""

_FOUND_IN = (",", "\t", ";", "|", None)  # in case of doubt the first
_MARKS = ("#", "%", "//", "!", ";")
_LONGEST_HEAD = 40  # rows; motion capture writes seven
_BINARY = (
    (b"\x1f\x8b", "a gzip file: unpack it"),
    (b"BZh", "a bzip2 file: unpack it"),
    (b"\xfd7zXZ", "an xz file: unpack it"),
    (b"\x28\xb5\x2f\xfd", "a Zstandard file: unpack it"),
    (b"PK\x03\x04", "a zip file or a spreadsheet (.xlsx, .ods): save it as csv"),
    (b"\xd0\xcf\x11\xe0", "an old spreadsheet (.xls): save it as csv"),
    (b"PAR1", "a Parquet file: write it as csv"),
    (b"ARROW1", "an Arrow or Feather file: write it as csv"),
    (b"\x89HDF", "an HDF5 file, as MATLAB 7.3 writes: write a table of it"),
    (b"MATLAB 5.0", "a MATLAB file: write a table of it (writetable)"),
    (b"\x93NUMPY", "a NumPy file: write it as csv"),
    (b"SQLite format 3", "an SQLite database: export a table"),
    (b"#ROSBAG", "a ROS bag: rosbag:FILE"),
    (b"\x89MCAP", "an MCAP bag: rosbag:FILE"),
    (b"ULog", "a ULog file: convert it to csv"),
    (b"%PDF", "a PDF file"),
)


@dataclass(frozen=True)
class Sheet:
    """The cells of a table.

    Args:
        file: that it is from.
        rows: of cells, without blanks around them and without quotes; no names, units or comments.
        lines: of the file, from 1, a row each.
        names: of the columns, without repeated blanks; none where no row names them.
        above: the words that stand over each name in a head of several rows, where there are any.
        units: of the columns as they are written, "" where there is none.
        said_at: the line that has the units.
        delimiter: between cells; None is white space.
        notes: on what was passed over or found out.
    """

    file: Path
    rows: list[list[str]]
    lines: list[int]
    names: list[str] = field(default_factory=list)
    above: list[str] = field(default_factory=list)
    units: list[str] = field(default_factory=list)
    said_at: int = 0
    delimiter: str | None = ","
    notes: list[str] = field(default_factory=list)

    def where(self, k: int) -> str:
        """What to call row k in a message."""
        return f"{self.file}, line {self.lines[k]}"

    def matches(self, name: str) -> list[int]:
        """The columns that a name may mean: by the whole name, or without the unit behind it, or with what
        stands above it; or by its number."""
        ways = (
            self.names,
            [split_unit(n)[0] for n in self.names],
            [f"{a}.{n}" for a, n in zip(self.above, self.names, strict=True)] if self.above else [],
        )
        for way in ways:
            if hits := [k for k, n in enumerate(way) if n == name]:
                other = int(name) if name.isdecimal() else hits[0]
                return hits + [other] * (other not in hits and other < len(self.names))
        if name.isdecimal() and (not self.names or int(name) < len(self.names)):
            return [int(name)]
        return []

    def column(self, name: str) -> int:
        """The column of a name, or of a number from 0.

        Raises:
            UnknownNameError: listing the names; DataError: where it may be one of several.
        """
        hits = self.matches(name)
        if not hits:
            raise UnknownNameError("column", name, self.names or ["0", "1", "..."], path=str(self.file))
        if len(hits) > 1:
            full = [f"{self.above[k]}.{self.names[k]}" for k in hits] if self.above else []
            better = full if len(set(full)) == len(full) else [str(k) for k in hits if str(k) != name]
            raise DataError(
                f"{name!r} is ambiguous: it may mean several columns",
                path=str(self.file),
                expected="a name that one column has",
                got="columns " + ", ".join(map(str, hits)) + " (counted from 0)",
                fix="write " + " or ".join(better) if better else "give the columns names of their own",
            )
        return hits[0]

    def cells(self, place: int) -> list[str]:
        """The cells of a column.

        Raises:
            DataError: for a row that has not so many.
        """
        try:
            return [row[place] for row in self.rows]
        except IndexError:
            k = next(k for k, row in enumerate(self.rows) if place >= len(row))
        raise DataError(
            "wrong number of columns",
            path=self.where(k),
            expected=f"at least {place + 1}",
            got=f"{len(self.rows[k])}",
            fix="mend or delete the row, or check the delimiter",
        )


def text_of(file: Path) -> tuple[str, list[str]]:
    """The text of a file in whatever encoding, and notes.

    Raises:
        DataError: where it is no text, with what it is.
    """
    raw = file.read_bytes()
    for start, what in _BINARY:
        if raw.startswith(start):
            raise _no_text(file, what)
    if raw.startswith((b"\xff\xfe\x00\x00", b"\x00\x00\xfe\xff")):
        return raw.decode("utf-32"), []
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace"), []
    head = raw[:4096]
    if 0 in head:
        for code, zeros, letters in (
            ("utf-16-le", head[1::2], head[::2]),
            ("utf-16-be", head[::2], head[1::2]),
        ):
            if not any(zeros) and 0 not in letters:
                return raw.decode(code, errors="replace"), []
        raise _no_text(file, "a binary file")
    try:
        return raw.decode("utf-8-sig"), []
    except UnicodeDecodeError:
        said = note("assumed", f"{file.name}: it is no UTF-8, read as cp1252 (Western European)")
        try:
            return raw.decode("cp1252"), [said]
        except UnicodeDecodeError:
            return raw.decode("latin-1"), [said]


def _no_text(file: Path, what: str) -> DataError:
    kind, _, fix = what.partition(": ")
    return DataError(
        "this is no text table",
        path=str(file),
        expected="a text file with a row a sample",
        got=kind,
        fix=fix or "give the table as text",
    )


def lines_of(text: str) -> list[str]:
    """The lines of a text, whichever way they end."""
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def read_sheet(
    file: Path,
    *,
    delimiter: str | None = None,
    comment: str | None = None,
    wanted: Sequence[str] = (),
    width: int | None = None,
    otherwise: str | None = ",",
) -> Sheet:
    """Read a table in whatever dialect.

    Args:
        file: a text file.
        delimiter: one of `DELIMITERS`; found if left out.
        comment: a mark that lines to pass over begin with, beside the usual ones.
        wanted: names of columns that are looked for, which tell the names from other rows of the head.
        width: how many columns there must be, where that is known: it tells the delimiter in case of doubt.
        otherwise: what stands between cells where nothing speaks against it; None is white space.

    Raises:
        DataError: the file is no text or has no rows, or rows do not fit the names.
    """
    text, notes = text_of(file)
    held = [(i, line) for i, line in _joined(lines_of(text)) if line.strip(" \t,;|\ufeff\x1a") != ""]
    between = DELIMITERS[delimiter] if delimiter is not None else otherwise
    if held and (found := re.fullmatch(r'\s*"?sep=(.|\\t)"?[\s,;]*', held[0][1], re.IGNORECASE)):
        held = held[1:]  # a spreadsheet's own word on the delimiter
        between = "\t" if found[1] == "\\t" else found[1]
        delimiter = delimiter or "said"
    marks = _MARKS + ((comment,) if comment else ())
    usual = [(i, line) for i, line in held if not _remark(line, marks)]
    if delimiter is None and usual:
        between = _delimiter([line for _, line in usual], width, otherwise)
        if between != otherwise:
            word = next(n for n, d in DELIMITERS.items() if d == between)
            notes.append(note("assumed", f"{file.name}: the delimiter is a {word}"))
    marks = tuple(m for m in marks if m != between)
    remarks = [(i, line) for i, line in held if _remark(line, marks)]
    kept = [(i, line) for i, line in held if not _remark(line, marks)]
    rows, lines = [split(line, between) for _, line in kept], [i for i, _ in kept]
    if not rows:
        raise DataError(
            "no rows",
            path=str(file),
            expected="rows of a stamp and numbers",
            got=f"{len(lines_of(text))} lines, all empty, comments or names",
            fix="restore the file",
        )
    return _headed(file, rows, lines, remarks, between, wanted, notes)


def _joined(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Lines with their numbers; a quoted cell may run over several."""
    waiting, since = "", 0
    for i, line in enumerate(lines, start=1):
        if waiting:
            waiting += "\n" + line
        elif line.count('"') % 2 and not _remark(line, _MARKS) and _closes(lines, i):
            waiting, since = line, i
        else:
            yield i, line
            continue
        if waiting.count('"') % 2 == 0:
            yield since, waiting
            waiting = ""
    if waiting:
        yield since, waiting


def _closes(lines: list[str], after: int) -> bool:
    """Whether a quote that is open at a line is closed in one of the next few."""
    return any(line.count('"') % 2 for line in lines[after : after + 20])


def _remark(line: str, marks: Sequence[str]) -> bool:
    start = line.lstrip(' \t"\ufeff')
    return start.startswith(tuple(marks)) and not start.upper().startswith(
        ("#N/A", "#NUM!", "#VALUE!", "#DIV/0!")
    )


def split(line: str, delimiter: str | None) -> list[str]:
    """The cells of a line."""
    line = line.replace("\n", " ")
    if '"' not in line:
        return line.split() if delimiter is None else [c.strip() for c in line.split(delimiter)]
    if delimiter is None:
        line, delimiter = line.strip().replace("\t", " "), " "
        cells = next(csv.reader([re.sub(" +", " ", line)], delimiter=" ", skipinitialspace=True))
    else:
        cells = next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    return [c.strip() for c in cells]


def _delimiter(lines: list[str], width: int | None, otherwise: str | None) -> str | None:
    """What stands between the cells: what leaves most of them numbers."""
    middle = len(lines) // 2
    sample = lines[middle : middle + 30]
    best, found = (False, 0.0), otherwise
    for candidate in dict.fromkeys((otherwise, *_FOUND_IN)):
        rows = [split(line, candidate) for line in sample]
        if min(map(len, rows)) < 2:
            continue
        fits = width is not None and all(len(row) == width for row in rows)
        sound = [bool(is_datum(c) or c in BLANKS) for row in rows for c in row]
        share = sum(sound) / len(sound)
        if (fits, share) > best:
            best, found = (fits, share), candidate
    return found


def _headed(
    file: Path,
    rows: list[list[str]],
    lines: list[int],
    remarks: list[tuple[int, str]],
    between: str | None,
    wanted: Sequence[str],
    notes: list[str],
) -> Sheet:
    """Tell names and units from rows of numbers."""
    wide = Counter(map(len, rows)).most_common(1)[0][0]
    if all(len(row) < wide or row[wide - 1] == "" for row in rows) and wide > 1:  # a delimiter at the end
        wide -= 1
    head, start = _head(rows, wide)
    names: list[str] = []
    above: list[str] = []
    units: list[str] = []
    said_at = 0
    if not head:
        before = [line for i, line in remarks if i < lines[0]]
        for line in before:
            words = split(line.strip().lstrip('"#%/!; \t'), between)
            names = words if len(words) == wide else names
    else:
        chosen = _names_row(rows, head, wanted)
        names = rows[chosen]
        while len(names) > wide and not names[-1]:
            names = names[:-1]
        over = [rows[k] for k in head if k < chosen and len(rows[k]) == len(rows[chosen])]
        if over and len(set(names)) < len(names):
            above = [".".join(filter(None, words)) for words in zip(*map(_filled, over), strict=True)][
                : len(names)
            ]
        for k in (k for k in head if k > chosen):
            if any(unit_of(c) for c in rows[k]):
                units, said_at = rows[k], lines[k]
            else:
                notes.append(note("skipped", f"{file.name}: line {lines[k]}, units not understood"))
        passed = [lines[k] for k in range(start) if k < chosen and rows[k] not in over]
        if passed:
            notes.append(note("skipped", f"{file.name}: {_counted(passed)} before the names"))
    rest, at = rows[start:], lines[start:]
    if not rest:
        raise DataError(
            "no rows",
            path=str(file),
            expected="rows of a stamp and numbers",
            got=f"{len(rows)} lines, all names",
            fix="restore the file",
        )
    if names and len(names) == wide - 1 and _row_names([row[0] for row in rest]):
        names, units = ["", *names], ["", *units] if units else []  # as R writes them
    _check_widths(file, rest, at, names, between)
    names = [" ".join(n.split()) for n in names]
    units = [*units, *[""] * (len(names) - len(units))]
    for k, name in enumerate(names):
        if not units[k] and unit_of(split_unit(name)[1]):
            units[k], said_at = split_unit(name)[1], said_at or lines[0]
    said = [i for i, _ in remarks if not (not head and names and i < lines[0])]
    if said:
        notes.append(note("skipped", f"{file.name}: {_counted(said)} of comment"))
    return Sheet(file, rest, at, names, above, units, said_at, between, notes)


def _counted(lines: Sequence[int]) -> str:
    return f"line {lines[0]}" if len(lines) == 1 else f"{len(lines)} lines ({lines[0]} the first)"


def _is_head(row: list[str]) -> bool:
    """Whether a row holds words and no number."""
    return not any(map(is_datum, row)) and any(c not in BLANKS for c in row)


def _head(rows: list[list[str]], wide: int) -> tuple[list[int], int]:
    """The rows of names and units, and where the numbers begin."""
    head: list[int] = []
    for k, row in enumerate(rows[:_LONGEST_HEAD]):
        follows = any(_is_head(r) and wide - 1 <= len(r) <= wide + 1 for r in rows[k + 1 : _LONGEST_HEAD])
        if _is_head(row):
            if wide - 1 <= len(row) <= wide + 1 or (len(row) > 1 and not follows and not head):
                head.append(k)  # names that do not fit the rows are refused later
            elif not follows:
                return head, k
        elif k == 0 and _numbered(row):
            head.append(k)
        elif not (follows and (len(row) != wide or row[0] in BLANKS)):
            return head, k
    return head, min(len(rows), _LONGEST_HEAD)


def _numbered(row: list[str]) -> bool:
    """Whether a row names columns by a word and by numbers."""
    others = [c for c in row if is_datum(c)]
    return (
        not is_datum(row[0])
        and row[0] not in BLANKS
        and all(c.isdecimal() and len(c) < 4 for c in others)
        and len(set(others)) == len(others) > 0
    )


def _names_row(rows: list[list[str]], head: list[int], wanted: Sequence[str]) -> int:
    """Which row of the head has the names: that with most of those that are looked for."""

    def hits(k: int) -> int:
        here = {*rows[k], *(split_unit(" ".join(c.split()))[0] for c in rows[k])}
        return sum(name in here for name in wanted)

    most = max(map(hits, head))
    if most:
        return next(k for k in head if hits(k) == most)
    last = len(head) - 1
    while last > 0 and sum(bool(unit_of(c)) for c in rows[head[last]]) * 2 > len(set(rows[head[last]])):
        last -= 1
    return head[last]


def _filled(row: list[str]) -> list[str]:
    """A row of titles, each of which holds until the next."""
    found: list[str] = []
    for cell in row:
        found.append(cell or (found[-1] if found else ""))
    return found


def _row_names(first: list[str]) -> bool:
    """Whether the first cells are labels of rows: a count, or words."""
    count = first[0].isdecimal() and [c for c in first] == [str(int(first[0]) + k) for k in range(len(first))]
    return count or not any(map(is_datum, first))


def _check_widths(
    file: Path, rows: list[list[str]], lines: list[int], names: list[str], between: str | None
) -> None:
    """Refuse a row with more cells than there are names."""
    if not names:
        return
    for row, line in zip(rows, lines, strict=True):
        if len(row) > len(names) and any(row[len(names) :]):
            halves = between == "," and len(row) > len(names) + 1
            raise DataError(
                "wrong number of columns",
                path=f"{file}, line {line}",
                expected=f"{len(names)}, as many as names",
                got=f"{len(row)}" + (": a decimal comma, with commas between cells too?" if halves else ""),
                fix="write the table with another delimiter, or with a decimal point"
                if halves
                else "mend or delete the row, or check the delimiter",
            )
