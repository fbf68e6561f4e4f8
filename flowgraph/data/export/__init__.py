"""Ways out: what a run gave back, in the forms of other tools.

Text that trajectory tools and spreadsheets read is written here without anybody's help (`text`). A result
becomes a tree of xarray (`trees`), a Parquet file a stream (`tables`), an MCAP file with the schemas that
Foxglove draws (`mcap_file`, `schemas`) or a recording for Rerun (`rerun_file`). What of a stream has a place
in space or on the Earth is decided once, for all of them (`places`). `forms` names the forms for the command.
"""

from flowgraph.data.export.text import write_table, write_tum
from flowgraph.data.export.trees import to_xarray

__all__ = ["to_xarray", "write_table", "write_tum"]
