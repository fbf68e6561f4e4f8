"""`cache`: the compiled filters that are kept on this machine."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

import typer

from flowgraph.cli.app import app
from flowgraph.cli.options import AsJson
from flowgraph.cli.terminal import err_console, out_console, print_json, reports_errors, table
from flowgraph.engines.c.compile import cache_folder, clear, kept
from flowgraph.errors import OutputError


@app.command()
@reports_errors
def cache(
    remove: Annotated[bool, typer.Option("--clear", help="Remove what is kept.")] = False,
    as_json: AsJson = False,
) -> None:
    """Tell which compiled filters are kept, where, and how large they are; or clear them."""
    folder = cache_folder()
    if folder is None:
        raise OutputError(
            "nothing can be kept: this user has no home folder",
            path="cache",
            expected="FLOWGRAPH_CACHE, XDG_CACHE_HOME or HOME",
            got="none of them",
            fix="set FLOWGRAPH_CACHE to a folder of your own",
        )
    found = kept(folder)
    freed = clear(folder) if remove else 0
    rows = []
    for name in dict.fromkeys(one.filter for one in found):
        mine = [one for one in found if one.filter == name]
        newest = datetime.fromtimestamp(mine[0].made).astimezone().isoformat(" ", "seconds")
        size = sum(one.bytes for one in mine)
        rows.append({"filter": name, "libraries": len(mine), "bytes": size, "newest": newest})
    if as_json:
        return print_json({"folder": str(folder), "filters": rows, "freed_bytes": freed})
    if rows:
        out_console.print(table(rows))
    size = sum(one.bytes for one in found)
    did = "removed" if remove else "kept"
    out_console.print(f"{did}: {len(found)} libraries, {size / 1e6:.1f} MB, in {folder}", markup=False)
    if found and not remove:
        err_console.print(
            "flowgraph cache --clear removes them; what is needed is compiled again", markup=False
        )
