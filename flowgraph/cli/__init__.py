"""The `flowgraph` command: list, show, run, lower, bench and study graphs from a terminal.

Results go to standard output, as a table or with `--json` as one object; everything else goes to standard
error. Exit status 2 means that the command was used wrongly, 1 that it failed. One module holds the commands
of one idea.
"""

from __future__ import annotations

import sys

from flowgraph.cli import (  # noqa: F401  each adds its commands
    bench,
    cache,
    calibrate,
    contents,
    filters,
    lower,
    quantise,
    study,
    tune,
    watch,
)
from flowgraph.cli.app import app
from flowgraph.cli.terminal import give_up

__all__ = ["app", "main"]


def main() -> None:
    """The entry point of the `flowgraph` command."""
    try:
        app()
    except OSError as error:  # from what prints the help
        give_up(f"{type(error).__name__}: {error}")
        sys.exit(1)
