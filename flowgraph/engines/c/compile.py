"""Compiling generated C with the system's compiler, once for each content.

Libraries are kept in a folder of the user's, under a hash of the text, the flags and the compiler's
version; the same filter is compiled once on a machine.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

from flowgraph.errors import FlowgraphError, MissingDependencyError, writes

FLAGS = (
    "-std=c99",
    "-O3",
    "--param=max-completely-peeled-insns=64",  # larger loops stay loops: half the time to compile
    "-march=native",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-ffp-contract=fast",
    "-fopenmp-simd",
    "-DFLOWGRAPH_SIMD",
)
"""What `engine="c"` compiles with; none of them changes what NaN or infinity mean."""


class CompileError(FlowgraphError):
    """The C compiler refuses, with its message."""


def compiler() -> str:
    """The C compiler: $CC, or cc.

    Raises:
        MissingDependencyError: where there is none.
    """
    wanted = os.environ.get("CC") or "cc"
    found = shutil.which(wanted)
    if found is None:
        raise MissingDependencyError(
            "the C engine needs a C compiler",
            path='engine="c"',
            expected="a compiler on the PATH, cc or what $CC names",
            got=f"no {wanted}",
            fix='install gcc or clang, or use engine="xla" or "python"',
        )
    return found


def cache_folder() -> Path:
    """Where compiled filters are kept: $FLOWGRAPH_CACHE, or flowgraph in the user's cache folder."""
    given = os.environ.get("FLOWGRAPH_CACHE")
    base = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(given) if given else Path(base) / "flowgraph" / "c"


@lru_cache(maxsize=8)
def _version(path: str) -> str:
    """The compiler's own words about itself, and what native means to it."""
    said = [
        subprocess.run([path, *ask], capture_output=True, text=True, check=False).stdout
        for ask in (["--version"], ["-march=native", "-Q", "--help=target"])
    ]
    return "\n".join(said)


def _first_error(said: str) -> str:
    lines = said.strip().splitlines()
    return next((line for line in lines if "error:" in line), lines[0] if lines else "")


def build(files: dict[str, str], flags: tuple[str, ...] = FLAGS) -> Path:
    """A shared library of C files (name -> text), from the cache or compiled now.

    Raises:
        MissingDependencyError: without a compiler.
        CompileError: where the compiler refuses.
        OutputError: where the cache folder cannot be written.
    """
    cc = compiler()
    said = "\0".join([cc, _version(cc), *flags, *(f"{n}\0{t}" for n, t in sorted(files.items()))])
    folder = cache_folder()
    target = folder / f"{hashlib.sha256(said.encode()).hexdigest()[:40]}.so"
    if target.exists():
        return target
    with writes(folder):
        folder.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(dir=folder))
    try:
        for name, text in files.items():
            (work / name).write_text(text)
        sources = sorted(n for n in files if n.endswith(".c"))
        command = [cc, *flags, "-fPIC", "-shared", "-o", "made.so", *sources, "-lm"]
        done = subprocess.run(command, cwd=work, capture_output=True, text=True, check=False)
        if done.returncode:
            raise CompileError(
                "the C compiler refuses the generated code",
                path=cc,
                expected="code that compiles",
                got=_first_error(done.stderr) or f"exit status {done.returncode}",
                fix="pass other flags; if the default ones fail, please report the graph",
            )
        os.replace(work / "made.so", target)  # whole or not at all, whoever else compiles the same
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return target
