"""A result as xarray: a dataset a stream, with units and frames as attributes."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from flowgraph.data.export.packages import needed
from flowgraph.types import leaves_of

if TYPE_CHECKING:
    from flowgraph.data.result import Result

_AXES = {3: ["x", "y", "z"], 4: ["w", "x", "y", "z"]}


def to_xarray(result: Result) -> Any:
    """An `xarray.DataTree` with a dataset a stream, each with a `time` of its own.

    A variable has the dimension `time` (int64 ns), and one more for each axis of its field, named
    FIELD_axis, or FIELD_axis0 and so on; vectors and attitudes have coordinates x, y, z and w, x, y, z. Unit
    and frame are attributes.

    Raises:
        MissingDependencyError: without xarray.
    """
    xarray = needed("xarray", "to_xarray", "xarray")
    about = {"graph": result.graph, "engine": result.engine, "ticks": result.ticks, **result.stats}
    streams = {}
    for name, series in result.series.items():
        variables: dict[str, Any] = {}
        coordinates: dict[str, Any] = {"time": ("time", series.time, {"long_name": "time", "units": "ns"})}
        for (field, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
            many = len(type_.shape) > 1
            dims = [f"{field}_axis{k if many else ''}" for k in range(len(type_.shape))]
            said = {k: v for k, v in (("units", type_.unit), ("frame", type_.frame)) if v}
            variables[field] = (["time", *dims], array, said)
            words = ("attitude", "quaternion", "orientation")
            if len(dims) == 1 and (
                array.shape[1] == 3 or (array.shape[1] == 4 and any(w in field for w in words))
            ):
                coordinates[dims[0]] = (dims[0], _AXES[array.shape[1]])
        streams[name] = xarray.Dataset(variables, coordinates)
    tree = xarray.DataTree.from_dict(streams, name=result.graph)
    tree.attrs.update(about)
    return tree


__all__ = ["to_xarray"]
