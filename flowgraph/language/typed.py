"""What an editor knows of a block: the kinds of its inputs, its settings and what comes out.

`@typed_block` makes the same block as `@block`; only type checkers see a difference. A port `track: Track`
wants a stream or a held value of tracks, each setting its own type, and the call gives streams of what the
function returns. Python's types can put parameters before those of a function, but no keywords among them,
nor take any away. Therefore

- `dt`, `t`, `xp`, `draw` and `path`, which the engine hands in, have a default in the function (`dt: float =
  0.0`, `xp: Namespace = np`): without one a checker wants them from the caller;
- where a block fires, and what it is called, goes by `wired`: `predict.wired(at=seen)(track, noise=0.1)`;
- it has one to four ports, given by position, up to three outputs, and no state.
"""

# The first overload that fits is meant, so they overlap: a function whose ports are three would also fit two,
# and one that returns Any, which alone fits Never, would fit a tuple.
# mypy: disable-error-code="overload-overlap"

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any, Concatenate, Generic, Never, ParamSpec, TypeAlias, TypeVar, overload

from flowgraph.errors import DeclarationError
from flowgraph.language.block import HANDED_IN, Block
from flowgraph.language.stream import Held, Stream

A = TypeVar("A")
B = TypeVar("B")
C = TypeVar("C")
D = TypeVar("D")
X = TypeVar("X")
Y = TypeVar("Y")
Z = TypeVar("Z")
P = ParamSpec("P")
Out = TypeVar("Out", covariant=True)

Namespace: TypeAlias = ModuleType
"""What `xp` is annotated with: an array namespace, as NumPy is. With `Any` in its place, mypy gives up on a
block of several outputs."""

if TYPE_CHECKING:
    In: TypeAlias = Stream[X] | Held[X]

    class Typed1(Block[Any], Generic[A, P, Out]):
        """A block with one port."""

        def __call__(self, a: In[A], /, *args: P.args, **settings: P.kwargs) -> Out: ...

        def wired(
            self, *, at: object = None, name: str | None = None, draws: Any = None
        ) -> Callable[Concatenate[In[A], P], Out]: ...

    class Typed2(Block[Any], Generic[A, B, P, Out]):
        """A block with two ports."""

        def __call__(self, a: In[A], b: In[B], /, *args: P.args, **settings: P.kwargs) -> Out: ...

        def wired(
            self, *, at: object = None, name: str | None = None, draws: Any = None
        ) -> Callable[Concatenate[In[A], In[B], P], Out]: ...

    class Typed3(Block[Any], Generic[A, B, C, P, Out]):
        """A block with three ports."""

        def __call__(self, a: In[A], b: In[B], c: In[C], /, *args: P.args, **settings: P.kwargs) -> Out: ...

        def wired(
            self, *, at: object = None, name: str | None = None, draws: Any = None
        ) -> Callable[Concatenate[In[A], In[B], In[C], P], Out]: ...

    class Typed4(Block[Any], Generic[A, B, C, D, P, Out]):
        """A block with four ports."""

        def __call__(
            self, a: In[A], b: In[B], c: In[C], d: In[D], /, *args: P.args, **settings: P.kwargs
        ) -> Out: ...

        def wired(
            self, *, at: object = None, name: str | None = None, draws: Any = None
        ) -> Callable[Concatenate[In[A], In[B], In[C], In[D], P], Out]: ...


@overload
def typed_block(
    step: Callable[Concatenate[A, B, C, D, P], Never], /
) -> Typed4[A, B, C, D, P, Stream[Any]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, B, C, D, P], tuple[X | None, Y | None, Z | None]], /
) -> Typed4[A, B, C, D, P, tuple[Stream[X], Stream[Y], Stream[Z]]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, B, C, D, P], tuple[X | None, Y | None]], /
) -> Typed4[A, B, C, D, P, tuple[Stream[X], Stream[Y]]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, B, C, D, P], X | None], /
) -> Typed4[A, B, C, D, P, Stream[X]]: ...
@overload
def typed_block(step: Callable[Concatenate[A, B, C, P], Never], /) -> Typed3[A, B, C, P, Stream[Any]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, B, C, P], tuple[X | None, Y | None, Z | None]], /
) -> Typed3[A, B, C, P, tuple[Stream[X], Stream[Y], Stream[Z]]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, B, C, P], tuple[X | None, Y | None]], /
) -> Typed3[A, B, C, P, tuple[Stream[X], Stream[Y]]]: ...
@overload
def typed_block(step: Callable[Concatenate[A, B, C, P], X | None], /) -> Typed3[A, B, C, P, Stream[X]]: ...
@overload
def typed_block(step: Callable[Concatenate[A, B, P], Never], /) -> Typed2[A, B, P, Stream[Any]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, B, P], tuple[X | None, Y | None, Z | None]], /
) -> Typed2[A, B, P, tuple[Stream[X], Stream[Y], Stream[Z]]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, B, P], tuple[X | None, Y | None]], /
) -> Typed2[A, B, P, tuple[Stream[X], Stream[Y]]]: ...
@overload
def typed_block(step: Callable[Concatenate[A, B, P], X | None], /) -> Typed2[A, B, P, Stream[X]]: ...
@overload
def typed_block(step: Callable[Concatenate[A, P], Never], /) -> Typed1[A, P, Stream[Any]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, P], tuple[X | None, Y | None, Z | None]], /
) -> Typed1[A, P, tuple[Stream[X], Stream[Y], Stream[Z]]]: ...
@overload
def typed_block(
    step: Callable[Concatenate[A, P], tuple[X | None, Y | None]], /
) -> Typed1[A, P, tuple[Stream[X], Stream[Y]]]: ...
@overload
def typed_block(step: Callable[Concatenate[A, P], X | None], /) -> Typed1[A, P, Stream[X]]: ...
def typed_block(step: Callable[..., Any], /) -> Any:
    """A block whose calls a type checker checks: `@typed_block`; otherwise as `@block`.

    Args:
        step: a function of one to four ports and keyword-only settings, all annotated. What the engine hands
            in (`dt`, `t`, `xp`, `draw`, `path`) has a default, which is never used.

    Returns:
        The `Block`. `block.wired(at=..., name=...)` is it with what is said of its place in the graph.

    Raises:
        DeclarationError: for what type checkers would get wrong where the block is called.
    """
    _need_checkable(step)
    frame = sys._getframe(1)
    return Block(step, local=None if frame.f_locals is frame.f_globals else frame.f_locals)


def _need_checkable(step: Callable[..., Any]) -> None:
    """Refuse a function whose calls type checkers cannot check."""
    path = getattr(step, "__name__", repr(step))
    parameters = list(inspect.signature(step).parameters.values())
    ports = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    if not 1 <= len(ports) <= 4:
        raise DeclarationError(
            "a typed block has one to four ports",
            path=path,
            expected="1 to 4 positional parameters",
            got=str(len(ports)),
            fix="write @block, whose calls are not checked; or make one signal of several",
        )
    for p in parameters:
        if p.annotation is p.empty and p.name not in HANDED_IN:
            raise DeclarationError(
                f"{p.name!r} has no type for a checker to check",
                path=path,
                expected="an annotation for each port and setting",
                got=f"{p.name} alone",
                fix=f"write {p.name}: Scalar, or what it is",
            )
        if p.name in HANDED_IN and p.default is p.empty and p not in ports:
            kind, default = ("Namespace", "np") if p.name == "xp" else ("float", "0.0")
            raise DeclarationError(
                f"{p.name!r} is handed in by the engine, and a checker would want it of whoever calls",
                path=path,
                expected="a default, which is never used",
                got=f"{p.name} without one",
                fix=f"write {p.name}: {kind} = {default}"
                if p.name in ("dt", "t", "xp")
                else f"write {p.name}: Any = None",
            )


__all__ = ["Namespace", "typed_block"]
