"""Records that are read one by one: where one is malformed the file is refused, or that record left out.

malformed=raise     a malformed packet, image or row is an error that names it
malformed=skip      it is left out, and counted in a note; where more than half are, that is an error again
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from flowgraph.blocks.datasets.settings import chosen
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["MALFORMED", "Records"]

MALFORMED: Mapping[str, str] = {"malformed": "packets, images and rows that are: raise, or skip"}
"""The setting of loaders that read records."""

WAYS = ("raise", "skip")


class Records:
    """What is read of a file record by record, and how often that failed.

    Args:
        given: the settings of the loader.
        path: the loader, for messages.

    Raises:
        UnknownNameError: for another value of `malformed`.
    """

    def __init__(self, given: Mapping[str, Any], path: str) -> None:
        self.skips = chosen(given, "malformed", WAYS, path) == "skip"
        self.errors: list[DataError] = []

    def read(self, one: Callable[..., Any], *arguments: Any) -> Any:
        """What `one` gives; None where it refuses its record and such are left out.

        Raises:
            DataError: of `one`, where they are not.
        """
        try:
            return one(*arguments)
        except DataError as error:
            if not self.skips:
                raise
            self.errors.append(error)
            return None

    def said(self, what: str, total: int) -> list[str]:
        """A note on what was left out of `total` records.

        Raises:
            DataError: where that is more than half.
        """
        if not self.errors:
            return []
        first, many = self.errors[0], len(self.errors)
        if 2 * many > total:
            raise DataError(
                f"most of it is malformed: {first.message}",
                path=first.path,
                expected=first.expected,
                got=f"{first.got}; {many} of {total}",
                fix="this may be a file of another family",
            )
        return [
            note("skipped", f"{what}: {many} malformed, left out; the first {first.path}: {first.message}")
        ]
