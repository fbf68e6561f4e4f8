"""What is found by a name is an attribute too: `result.belief` is `result["belief"]`."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Generic, TypeVar

from flowgraph.errors import UnknownNameError

T = TypeVar("T")


class ByName(Generic[T]):
    """Parts by name, in brackets or as attributes.

    A subclass says which (`_parts`), or how (`_names` and `__getitem__`).
    """

    def _names(self) -> Iterable[str]:
        """Of the parts."""
        return self._parts()[1]

    def _parts(self) -> tuple[str, Mapping[str, T], str]:
        """What a part is called in an error, the parts by name, and the place that the error names."""
        raise NotImplementedError

    def __getitem__(self, name: Any) -> Any:
        what, parts, path = self._parts()
        if name not in parts:
            raise UnknownNameError(what, name, parts, path=path)
        return parts[name]

    def __getattr__(self, name: str) -> T:
        if name.startswith("_") or name in type(self).__annotations__:  # not there yet: it is being unpickled
            raise AttributeError(name)
        try:
            found: T = self[name]
        except UnknownNameError as error:
            raise AttributeError(str(error)) from None
        return found

    def __dir__(self) -> list[str]:
        """The parts are attributes too."""
        return sorted({*super().__dir__(), *(name for name in self._names() if name.isidentifier())})
