"""Compiling generated C with the system's compiler, once for each content.

Libraries are kept in a folder of the user's, under a digest of the text, the flags and what the compiler
says of itself; the same filter is compiled once on a machine. Behind each library stands a digest of its
bytes, and what does not agree with it is compiled again, for a library that was cut would kill the process
that uses it. Each is made in a folder of its own beside the others, and renamed. What a killed process has
left of such a folder is swept by the next one that compiles.
"""

from __future__ import annotations

import ctypes
import functools
import hashlib
import os
import platform
import re
import shlex
import shutil
import signal
import stat
import subprocess
import tempfile
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from flowgraph.data.files import content_of, lock, put
from flowgraph.errors import FlowgraphError, MissingDependencyError, OutputError, writes

_COMMON = (
    "-std=c99",
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-fopenmp-simd",
    "-DFLOWGRAPH_SIMD",
)
_NARROW = ("-mprefer-vector-width=256",) if platform.machine() in ("x86_64", "AMD64") else ()

_FULL = "-O3"
_FIRST = (
    "-O1",
    "-fcaller-saves",
    "-fexpensive-optimizations",
    "-finline-functions",
    "-finline-small-functions",
    "-fpartial-inlining",
    "-fpeel-loops",
    "-fpredictive-commoning",
    "-fschedule-insns2",
    "-fsplit-loops",
    "-fstore-merging",
    "-fstrict-aliasing",
    "-ftree-loop-distribution",
    "-ftree-vectorize",
    "-ftree-vrp",
    "-funswitch-loops",
    "-fvect-cost-model=dynamic",
    "--param=sccvn-max-alias-queries-per-access=50",
)
"""gcc's first level, and of the others what generated code gains by: six tenths of the time to compile."""

FLAGS = (*_FIRST, *_COMMON, *_NARROW)
"""What `engine="c"` compiles with; none of them changes what NaN or infinity mean.

Straight code is packed into vectors, of half the length where a processor has AVX-512: with whole ones
gcc 12.2 puts elements of one row into the next.
"""

LANES = (_FULL, *_COMMON, *_NARROW)
"""The flags for runs that go as lanes: the vectors are in the text, and loops go around them."""

LOOPS = (
    *_FIRST,
    *_COMMON,
    "-fno-tree-slp-vectorize",  # so loops may have whole vectors, see above
    "--param=max-completely-peeled-insns=64",  # larger loops stay loops: half the time to compile
)
"""The flags for a filter whose time goes into long loops, as over particles."""

_MARK = b"\nflowgraph library, sha256 "
_WORK = "work-"
_NAME = re.compile(r"(?:(.*)-)?[0-9a-f]{40}")


class CompileError(FlowgraphError):
    """The C compiler refuses or fails, with its message."""


def compiler() -> str:
    """The C compiler: the program that $CC names, or cc.

    Raises:
        MissingDependencyError: where there is none.
    """
    return _command()[0]


def _command() -> list[str]:
    """The compiler's program, and the arguments that $CC may have after it."""
    wanted = os.environ.get("CC", "").strip() or "cc"
    found = shutil.which(wanted)
    words = [wanted]
    if found is None:
        with suppress(ValueError):
            words = shlex.split(wanted)
            found = shutil.which(words[0])
    if found is None:
        raise MissingDependencyError(
            "the C engine needs a C compiler",
            path='engine="c"',
            expected="a compiler on the PATH, cc or what $CC names",
            got=f"no {wanted}",
            fix='install gcc or clang, or use engine="xla" or "python"',
        )
    return [os.path.abspath(found), *words[1:]]  # it is started in other folders than this one


def cache_folder() -> Path | None:
    """Where compiled filters are kept: $FLOWGRAPH_CACHE, or flowgraph/c in the user's cache folder.

    That is $XDG_CACHE_HOME or ~/.cache; None where neither is an absolute path and nobody's home is known, as
    in a container.
    """
    given = os.environ.get("FLOWGRAPH_CACHE")
    if given:
        return Path(given).absolute()
    base = Path(os.environ.get("XDG_CACHE_HOME") or "")
    if not base.is_absolute():
        home = Path(os.environ.get("HOME") or _home())
        if not home.is_absolute():
            return None
        base = home / ".cache"
    return base / "flowgraph" / "c"


def _home() -> str:
    try:
        import pwd  # not everywhere

        return pwd.getpwuid(os.getuid()).pw_dir
    except (ImportError, KeyError):
        return ""


def places() -> Iterator[Path]:
    """Folders for libraries and texts, the best first; another than the user's is said once."""
    first = cache_folder()
    if first is not None:
        yield first
        if os.environ.get("FLOWGRAPH_CACHE"):
            return  # asked for: what is wrong with it is an error
    own = Path(tempfile.gettempdir()) / f"flowgraph-{os.getuid()}"
    _say(f"compiled filters are kept in {own}: {first or 'a home folder'} cannot be used")
    with writes(own):
        own.mkdir(mode=0o700, exist_ok=True)
        found = own.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o022:
        raise OutputError(
            "this folder is not ours alone, and programs in it could be anybody's",
            path=str(own),
            expected="a folder that only its owner can write to",
            got=f"mode {stat.S_IMODE(found.st_mode):o} of user {found.st_uid}",
            fix="set FLOWGRAPH_CACHE to a folder of your own",
        )
    yield own


@functools.cache
def _say(sentence: str) -> None:
    warnings.warn(sentence, RuntimeWarning, stacklevel=2)


@functools.lru_cache(maxsize=8)
def _version(command: tuple[str, ...]) -> str:
    """The compiler's own words about itself, and what native means to it."""
    asked = (
        ["--version"],
        ["-march=native", "-Q", "--help=target"],
        ["-march=native", "-dM", "-E", "-xc", "-"],
    )
    return "\n".join(said for _, said, _ in _run([[*command, *ask] for ask in asked], None))


def _run(commands: list[list[str]], folder: Path | None) -> list[tuple[int, str, str]]:
    """Exit status, and what each program wrote to its two ends; all go on at once, and end with us.

    Raises:
        CompileError: where one cannot be started.
    """
    environment = os.environ if folder is None else {**os.environ, "TMPDIR": str(folder)}
    with ExitStack() as stack:
        running = []
        try:
            for command in commands:
                running.append(
                    stack.enter_context(
                        subprocess.Popen(
                            command,
                            cwd=folder,
                            env=environment,
                            stdin=subprocess.DEVNULL,
                            stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE,
                            text=True,
                            errors="replace",
                            process_group=0,
                        )
                    )
                )
            said = [process.communicate() for process in running]
        except BaseException as error:
            for process in running:
                if process.returncode is None:
                    with suppress(ProcessLookupError):
                        os.killpg(
                            process.pid, signal.SIGKILL
                        )  # with the compiler proper, which it has started
            if not isinstance(error, OSError):
                raise
            raise CompileError(
                "the C compiler cannot be started",
                path=commands[0][0],
                expected="a program, cc or what $CC names",
                got=f"{type(error).__name__}: {error.strerror or error}",
                fix='install gcc or clang, or use engine="xla" or "python"',
            ) from error
    return [(process.returncode, *texts) for process, texts in zip(running, said, strict=True)]


def _first_error(said: str) -> str:
    lines = said.strip().splitlines()
    return next((line for line in lines if "error:" in line), lines[0] if lines else "")


def build(files: dict[str, str], flags: tuple[str, ...] = FLAGS) -> Path:
    """A shared library of C files (name -> text), from the cache or compiled now.

    Raises:
        MissingDependencyError: without a compiler.
        CompileError: where the compiler refuses, or makes nothing.
        OutputError: where the cache folder cannot be written, and no other place can.
    """
    return _built(files, flags)[0]


def load(files: dict[str, str], flags: tuple[str, ...] = FLAGS) -> ctypes.CDLL:
    """The library of C files, loaded into this process.

    Raises:
        MissingDependencyError, OutputError: as for `build`; CompileError: also where what the compiler made
            cannot be loaded.
    """
    while True:
        target, made = _built(files, flags)
        try:
            return ctypes.CDLL(str(target))
        except OSError as error:
            target.unlink(missing_ok=True)  # whatever it is, it is of no use
            if not made:
                continue  # it was kept from before
            raise CompileError(
                "what the C compiler made cannot be loaded",
                path=compiler(),
                expected="a shared library for this machine, in a folder from which programs may run",
                got=str(error)[:300],
                fix="look at $CC and the flags; where the folder forbids programs, set FLOWGRAPH_CACHE",
            ) from error


def _built(files: dict[str, str], flags: tuple[str, ...]) -> tuple[Path, bool]:
    """The library, and whether it was compiled now."""
    command = _command()
    flags = _understood(flags, _version(tuple(command)))
    said = "\0".join(
        [*command, _version(tuple(command)), *flags, *(f"{n}\0{t}" for n, t in sorted(files.items()))]
    )
    stem = next((n[:-2] for n in files if n.endswith(".c")), "code")
    name = f"{stem}-{hashlib.sha256(said.encode()).hexdigest()[:40]}.so"
    refused: OutputError | None = None
    for folder in places():
        target = folder / name
        if _is_whole(target):
            return target, False
        try:
            _compile(command, flags, files, folder, target)
        except OutputError as error:
            refused = error
        else:
            return target, True
    assert refused is not None  # there is one place at least
    raise refused


def _understood(flags: tuple[str, ...], version: str) -> tuple[str, ...]:
    """These flags; for another compiler than gcc its whole third level in place of parts of gcc's."""
    if "Free Software Foundation" in version:
        return flags
    others = tuple(f for f in flags if f not in _FIRST)
    return flags if len(others) == len(flags) else (_FULL, *others)


def _is_whole(library: Path) -> bool:
    try:
        content, mark, digest = content_of(library).rpartition(_MARK)
    except OSError:
        return False
    return bool(mark) and hashlib.sha256(content).hexdigest().encode() == digest


def _compile(
    command: list[str], flags: tuple[str, ...], files: dict[str, str], folder: Path, target: Path
) -> None:
    """Compile into a place.

    Raises:
        CompileError: where the compiler refuses; OutputError: where the folder or the disk does.
    """
    with writes(folder):
        folder.mkdir(parents=True, exist_ok=True)
    _sweep(folder)
    with _workplace(folder) as work:
        with writes(folder):
            for name, text in files.items():
                (work / name).write_text(text, encoding="utf-8")
        sources = sorted(n for n in files if n.endswith(".c"))
        calls = [[*command, *flags, "-fPIC", "-c", "-o", f"{n}.o", n] for n in sources]
        done = _run(calls, work)
        if not any(status for status, _, _ in done):
            objects = [f"{n}.o" for n in sources]
            done = _run([[*command, *flags, "-shared", "-o", "made.so", *objects, "-lm"]], work)
        status, said, complained = next((d for d in done if d[0]), done[0])
        made = work / "made.so"
        if status and "No space left on device" in complained:
            raise OutputError(
                "the disk is full",
                path=str(folder),
                expected="room for a compiled filter",
                got=_first_error(complained),
                fix="make room, or set FLOWGRAPH_CACHE to a folder on another disk",
            )
        if status or not made.is_file() or not made.stat().st_size:
            how = f"signal {-status}" if status < 0 else f"exit status {status}"
            raise CompileError(
                "the C compiler refuses the generated code" if status > 0 else "the C compiler made nothing",
                path=command[0],
                expected="code that compiles" if status > 0 else "a shared library",
                got=_first_error(complained or said) or how,
                fix="pass other flags; if the default ones fail, please report the graph"
                if status > 0
                else "look at what $CC names, at the memory and at the disk",
            )
        content = content_of(made)
        put(target, content + _MARK + hashlib.sha256(content).hexdigest().encode(), lasting=False)


@contextmanager
def _workplace(folder: Path) -> Iterator[Path]:
    """A folder to compile in, locked while that goes on."""
    with writes(folder):
        while True:
            work = Path(tempfile.mkdtemp(prefix=_WORK, dir=folder))
            with suppress(FileNotFoundError):
                descriptor = os.open(work, os.O_RDONLY)
                lock(descriptor)
                if work.exists():
                    break
                os.close(descriptor)  # swept by another process before it was locked
    try:
        yield work
    finally:
        _remove(work)
        os.close(descriptor)


@dataclass(frozen=True)
class Kept:
    """A compiled filter in the cache, or the text that it is compiled from.

    Args:
        file: of the library or text.
        filter: whose it is.
        bytes: its size.
        made: when, in seconds since 1970.
    """

    file: Path
    filter: str
    bytes: int
    made: float


def kept(folder: Path) -> list[Kept]:
    """What is kept of filters in a cache folder, compiled ones and their texts, the newest first."""
    found = []
    for file in (*folder.glob("*.so"), *folder.glob("*.json")):
        name = _NAME.fullmatch(file.stem)
        with suppress(OSError):
            if name:  # not a library of the user's own
                status = file.stat()
                found.append(Kept(file, name[1] or "unnamed", status.st_size, status.st_mtime))
    return sorted(found, key=lambda k: -k.made)


def clear(folder: Path) -> int:
    """Remove what is kept in a cache folder, and nothing else that may lie there; returns the bytes freed.

    A process that has loaded a library keeps it.

    Raises:
        OutputError: for a library that cannot be removed.
    """
    freed = 0
    if folder.is_dir():
        _sweep(folder)
    for one in kept(folder):
        with writes(one.file):
            one.file.unlink(missing_ok=True)
        freed += one.bytes
    return freed


def _remove(folder: Path) -> None:
    """Remove a folder, in which a compiler that has outlived who started it may still write for a moment."""
    for _ in range(10):
        shutil.rmtree(folder, ignore_errors=True)
        if not folder.exists():
            return


def _sweep(folder: Path) -> None:
    """Remove what killed processes have left: folders to compile in, and halves of libraries."""
    for old in [*folder.glob(f"{_WORK}*"), *folder.glob(".*.so.part"), *folder.glob(".*.json.part")]:
        with suppress(OSError):
            descriptor = os.open(old, os.O_RDONLY)
            try:
                if lock(descriptor, wait=False):
                    _remove(old) if old.is_dir() else old.unlink(missing_ok=True)
            finally:
                os.close(descriptor)
