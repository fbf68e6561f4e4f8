"""The command that the others belong to."""

from __future__ import annotations

import typer

app = typer.Typer(
    help="Declare a filter once as a graph; draw it, simulate it, and lower it.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
