"""Files that are whole or not there, and that are read within bounds.

What is written goes to a hidden file beside its place, `.NAME.part`, and is then renamed, which a file system
does at once or not at all: whoever looks, and whenever a process is killed, finds the old file or the new
one. A part that a killed process has left is taken over by the next that writes the same file; a lock on it,
which ends with the process that holds it, tells the two cases apart.

What is read must be a regular file, for a pipe would keep its reader waiting, and of a size that is known
before memory is taken for it.
"""

from __future__ import annotations

import errno
import hashlib
import io
import os
import stat
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from flowgraph.errors import OutputError, writes

try:
    import fcntl
except ImportError:  # on Windows, where nothing is locked
    fcntl = None  # type: ignore[assignment]

MOST = 2**30
"""Bytes of the largest description (a pipeline, a study, a table of settings) that is read."""

_EXPANDED = 32
_ROOM = 2**24


def need_place(file: str | Path) -> Path:
    """Where a file will be written; refused before the work whose outcome it is to hold.

    Raises:
        OutputError: where it cannot be written.
    """
    with writes(file):
        if "\0" in str(file):
            raise OSError(errno.EINVAL, "a zero byte in the name")
        place = Path(os.path.realpath(file))
        if place.is_dir():
            raise IsADirectoryError(errno.EISDIR, "a folder is in its place")
        if not place.parent.is_dir():
            raise FileNotFoundError(errno.ENOENT, "there is no such folder")
        if place.exists() and not os.access(place, os.W_OK):
            raise PermissionError(errno.EACCES, "the file that is there is for reading only")
        if not place.exists() and not os.access(place.parent, os.W_OK):
            raise PermissionError(errno.EACCES, "the folder is for reading only")
    return place


@contextmanager
def whole(file: str | Path, *, lasting: bool = True) -> Iterator[BinaryIO]:
    """A stream whose content takes the place of `file` when the block ends well, and is dropped otherwise.

    A link is followed, and the rights of a file that is replaced are kept. What is no regular file, such as
    /dev/stdout, is written to as it is.

    Args:
        file: to write; its folder must be there.
        lasting: whether to wait until the disk has it, so that it outlives a loss of power as well.

    Raises:
        OutputError: where it cannot be written; what was there before is then there still.
    """
    place = need_place(file)
    with writes(file):
        if place.exists() and not place.is_file():
            with open(place, "wb") as stream:
                yield stream
            return
        part = place.with_name(_part_name(place.name))
        with _own(part) as stream:
            try:
                yield stream
                stream.flush()
                if place.exists():
                    os.fchmod(stream.fileno(), stat.S_IMODE(place.stat().st_mode))
                if lasting:
                    os.fsync(stream.fileno())
                os.replace(part, place)
            except BaseException:
                part.unlink(missing_ok=True)
                raise


def put(file: str | Path, content: str | bytes, *, lasting: bool = True) -> Path:
    """Write a whole file, as `whole` does; text in UTF-8. Returns its path.

    Raises:
        OutputError: where it cannot be written.
    """
    with whole(file, lasting=lasting) as stream:
        stream.write(content if isinstance(content, bytes) else content.encode())
    return Path(file)


def put_new(folder: str | Path, contents: Mapping[str, str], *, what: str) -> dict[str, Path]:
    """Write files into a folder, made if missing, over none that holds something else.

    Args:
        folder: for the files.
        contents: text by file name.
        what: they are of, for the message: "pipeline".

    Raises:
        OutputError: naming the first file of that name that holds something else, before any is written; or
            where one cannot be written.
    """
    target = Path(folder)
    with writes(target):
        target.mkdir(parents=True, exist_ok=True)
    for name, text in contents.items():
        file = target / name
        with writes(file):
            other = os.path.lexists(file) and (not file.is_file() or file.read_bytes() != text.encode())
        if other:
            raise OutputError(
                "another file is already here",
                path=str(file),
                expected=f"an empty folder, or the same {what}",
                got=f"a different {name}",
                fix="choose another folder, or remove the old one first",
            )
    return {name: put(target / name, text) for name, text in contents.items()}


def lock(descriptor: int, *, wait: bool = True) -> bool:
    """Lock an open file or folder until it is closed or its process ends; False where another holds it.

    A file system without locks gives every one.
    """
    if fcntl is None:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL):
            raise
    return True


def _part_name(name: str) -> str:
    part = f".{name}.part"
    return part if len(os.fsencode(part)) <= 255 else f".{hashlib.sha256(os.fsencode(name)).hexdigest()}.part"


@contextmanager
def _own(part: Path) -> Iterator[BinaryIO]:
    """The empty part, open and locked; that of a process that was killed is taken over."""
    while True:
        flags = os.O_CREAT | os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
        stream = open(os.open(part, flags, 0o666), "w+b")  # noqa: SIM115  # closed below, or when it is ours no more
        try:
            lock(stream.fileno())
            with suppress(FileNotFoundError):
                if os.path.samestat(os.stat(part), os.fstat(stream.fileno())):
                    stream.truncate(0)
                    yield stream
                    return
        finally:
            stream.close()  # else whoever held it has renamed or removed it meanwhile: make another


@contextmanager
def claimed(file: Path, *, by: str) -> Iterator[str | None]:
    """Hold a lock file while the block runs; what its holder said of itself, where another has it.

    The file is removed at the end. One that a killed process has left holds nobody up.

    Args:
        file: the lock.
        by: what to say of ourselves in it.

    Raises:
        OutputError: where it cannot be made.
    """
    holder: str | None = None
    with writes(file):
        while True:
            descriptor = os.open(file, os.O_CREAT | os.O_RDWR | getattr(os, "O_CLOEXEC", 0), 0o666)
            try:
                if not lock(descriptor, wait=False):
                    holder = os.pread(descriptor, 200, 0).decode(errors="replace").strip() or "somebody"
                    break
                with suppress(FileNotFoundError):
                    if os.path.samestat(os.stat(file), os.fstat(descriptor)):
                        os.ftruncate(descriptor, 0)
                        os.pwrite(descriptor, by.encode(), 0)
                        break
            except BaseException:
                os.close(descriptor)
                raise
            os.close(descriptor)
    try:
        yield holder
    finally:
        if holder is None:
            file.unlink(missing_ok=True)
        os.close(descriptor)


def content_of(file: str | Path, *, most: int = MOST) -> bytes:
    """The bytes of a regular file.

    Raises:
        OSError: where it cannot be read, is no regular file, or holds more than `most` bytes.
    """
    descriptor = os.open(file, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_CLOEXEC", 0))
    with open(descriptor, "rb") as stream:
        found = os.fstat(descriptor)
        if not stat.S_ISREG(found.st_mode):
            raise OSError(errno.EINVAL, "this is no regular file", str(file))
        if found.st_size > most:
            raise OSError(errno.EFBIG, f"{found.st_size} bytes, which is more than {most}", str(file))
        return stream.read()


def text_of(file: str | Path, *, most: int = MOST) -> str:
    """The text of a regular file in UTF-8.

    Raises:
        OSError: as `content_of`; UnicodeDecodeError, a ValueError: where it is no such text.
    """
    return content_of(file, most=most).decode("utf-8-sig")


def arrays_of(file: str | Path, *, most: int | None = None) -> dict[str, np.ndarray]:
    """The arrays of an `.npz` file, each checked to be of the size that it says before it is read.

    Args:
        file: the file.
        most: bytes of all arrays together; if left out, 32 times the file's own size and 16 MiB.

    Raises:
        OSError, ValueError: where it is no such file, is damaged, or holds more; nothing in it is run.
    """
    content = content_of(file, most=2**40)
    limit = _EXPANDED * len(content) + _ROOM if most is None else most
    found: dict[str, np.ndarray] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = archive.infolist()
            if sum(m.file_size for m in members) > limit:
                raise ValueError(f"its arrays take {sum(m.file_size for m in members)} bytes, over {limit}")
            for member in members:
                if not member.filename.endswith(".npy") or member.filename[:-4] in found:
                    raise ValueError(f"no array, or one of a name that is taken: {member.filename[:60]!r}")
                with archive.open(member) as stream:
                    found[member.filename[:-4]] = _array(stream.read(member.file_size + 1), member.filename)
    except (OSError, ValueError):
        raise
    except MemoryError:
        raise ValueError("it does not fit the memory") from None
    except Exception as error:  # zlib.error, BadZipFile, NotImplementedError, RuntimeError of a password, ...
        raise ValueError(f"{type(error).__name__}: {error}") from None
    return found


def _array(content: bytes, name: str) -> np.ndarray:
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in read:
        raise ValueError(f"{name[:60]}: an array of version {version}")
    shape, fortran, dtype = read[version](stream)
    count = 1
    for size in shape:
        if type(size) is not int or size < 0:
            raise ValueError(f"{name[:60]}: an array of shape {str(shape)[:60]}")
        count *= size
    if dtype.hasobject or dtype.kind not in "biufU" or count * dtype.itemsize != len(content) - stream.tell():
        raise ValueError(
            f"{name[:60]}: {dtype.name} of shape {str(shape)[:60]} in {len(content) - stream.tell()} bytes"
        )
    flat = np.frombuffer(content, dtype=dtype, count=count, offset=stream.tell())
    return flat.reshape(shape, order="F" if fortran else "C").copy(order="K")


__all__ = ["MOST", "arrays_of", "claimed", "content_of", "lock", "put", "put_new", "text_of", "whole"]
