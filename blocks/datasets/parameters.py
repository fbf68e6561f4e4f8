"""`parameters.txt` of the course: tag map, camera matrix, distortion and mount, in MATLAB's notation in
prose.

The file is read for what it says, in whatever order: bracketed matrices, each with the words before it, and
lengths in metres. A 3 x 3 matrix is the camera's, five numbers are its distortion, three after "XYZ" are
where the IMU sits in the camera, a table of whole numbers is the mat. Nothing of the file is evaluated.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flowgraph.blocks.vision.camera import COURSE_CAMERA, COURSE_MOUNT, Camera, Mount, course_mount
from flowgraph.blocks.vision.tags import TagMap, course_map, grid_map
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError

__all__ = ["Parameters", "parse_parameters"]

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_ANGLE = re.compile(
    rf"yaw\s*[=:]\s*(?P<sign>-?)\s*"
    rf"(?:(?P<pi>pi)\s*(?:/\s*(?P<by>{_NUMBER}))?|(?P<number>{_NUMBER}))",
    re.IGNORECASE,
)
_LENGTH = re.compile(rf"(?P<value>{_NUMBER})\s*m\b")
_COLUMNS = re.compile(r"(\d+)\s*(?:and|-|to|,)\s*(\d+)")


@dataclass(frozen=True)
class Parameters:
    """What a flight of the course is read with.

    Args:
        tag_map: the mat.
        camera: of raw images.
        mount: the body (IMU) in the camera.
        notes: what was not in the file, and taken from the course.
    """

    tag_map: TagMap
    camera: Camera
    mount: Mount
    notes: tuple[str, ...] = ()

    @classmethod
    def of_the_course(cls) -> Parameters:
        """The parameters of the course's own file."""
        return cls(course_map(), COURSE_CAMERA, COURSE_MOUNT)


def parse_parameters(file: str | Path) -> Parameters:
    """Read a `parameters.txt`. What it does not say is as in the course, and a note says what that was.

    Raises:
        DataError: the file is missing, or a matrix in it is malformed; names file and line.
    """
    file = Path(file)
    try:
        text = file.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise DataError(
            "the parameters cannot be read",
            path=str(file),
            expected="a text file such as parameters.txt",
            got=f"{type(error).__name__}: {error.strerror or error}",
            fix="give its path, or leave it out for the course's own",
        ) from error
    text = re.sub(r"\.\.\.[^\n]*", " ", text)  # MATLAB's continuation; the line number stays
    found: dict[str, np.ndarray] = {}
    for match in re.finditer(r"\[(?P<inside>[^\[\]]*)\]", text):
        table = _matrix(match["inside"], file, 1 + text.count("\n", 0, match.start()))
        before = text[: match.start()].rstrip().rpartition("\n\n")[2][-200:].lower()
        name = _meant(table, before)
        if name:
            found.setdefault(name, table)
    notes = []
    camera, mount, tag_map = COURSE_CAMERA, COURSE_MOUNT, course_map()
    try:
        if "K" in found or "distortion" in found:
            K = found.get("K", COURSE_CAMERA.K)
            camera = Camera(K, tuple(found.get("distortion", np.array(COURSE_CAMERA.distortion)).ravel()))
    except DeclarationError as error:
        raise DataError(
            "the camera is malformed", path=f"{file}: {error.path}", expected=error.expected, got=error.got,
            fix=error.fix,
        ) from error  # fmt: skip
    angle = _ANGLE.search(text)
    if "xyz" in found or angle:
        xyz = found["xyz"].ravel() if "xyz" in found else COURSE_MOUNT.origin
        mount = course_mount(xyz, _angle(angle) if angle else math.pi / 4)
    if "ids" in found:
        tag_map = _mat(found["ids"], text)
    for what, there in (
        ("camera matrix", "K" in found),
        ("distortion", "distortion" in found),
        ("XYZ", "xyz" in found),
        ("yaw", bool(angle)),
        ("tag ids", "ids" in found),
    ):
        if not there:
            notes.append(note("assumed", f"{file.name}: no {what}; that of the course is taken"))
    return Parameters(tag_map, camera, mount, tuple(notes))


def _matrix(inside: str, file: Path, line: int) -> np.ndarray:
    """The numbers between two brackets: rows end at ; or at a line's end."""
    rows = [row for row in re.split(r";", inside.replace("\n", " ")) if row.strip()]
    cells = [re.split(r"[,\s]+", row.strip().strip(",")) for row in rows]
    try:
        table = np.array([[float(cell) for cell in row] for row in cells])
        if not np.isfinite(table).all() or any("_" in cell for row in cells for cell in row):
            raise ValueError
    except ValueError:
        raise DataError(
            "a matrix is malformed",
            path=f"{file}, line {line}",
            expected="rows of finite numbers of one length, a ; between them",
            got=repr(inside.strip()[:60]),
            fix="mend the file",
        ) from None
    return table


def _meant(table: np.ndarray, before: str) -> str | None:
    """What a matrix is, from its shape and the words before it."""
    if table.shape == (3, 3) and np.allclose(table[2], [0.0, 0.0, 1.0]):
        return "K"
    if table.size == 5 and ("distort" in before or "k1" in before):
        return "distortion"
    if table.size == 3 and "xyz" in before:
        return "xyz"
    if min(table.shape) >= 2 and (table == np.round(table)).all() and len(np.unique(table)) == table.size:
        return "ids"
    return None


def _angle(match: re.Match[str]) -> float:
    size = math.pi / float(match["by"] or 1.0) if match["pi"] else float(match["number"])
    return -size if match["sign"] else size


def _mat(ids: np.ndarray, text: str) -> TagMap:
    """The mat with lengths as the prose gives them: first the side, then the gap, then the wide gap."""
    lengths = [float(m["value"]) for m in _LENGTH.finditer(text) if 0.001 < float(m["value"]) < 5.0]
    side, gap, wide = (*lengths[:3], *(0.152, 0.152, 0.178)[len(lengths[:3]) :])
    after = [int(a) for a, b in _COLUMNS.findall(text.partition("columns")[2][:80]) if int(b) == int(a) + 1]
    wide_after = [a for a in after if a < ids.shape[1]] or [c for c in (3, 6) if c < ids.shape[1]]
    return grid_map(ids.astype(int), side=side, gap=gap, wide_gap=wide, wide_after=wide_after)
