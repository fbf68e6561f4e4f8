"""Runs and particles shared out among devices: what lies where.

A share `{"runs": 2, "particles": 4}` is a mesh of 2 by 4 devices whose axes have these names. An array is cut
along its axes of a name, and lies whole on the devices of the others. Runs, where there are several, are the
axis in front of registers, of outputs and of inputs of their own; other axes are those that types name. What
the instructions make of these XLA cuts likewise, and adds what devices must tell one another. Runs tell
nothing. Of particles, sums go over all devices, and a cloud that is resampled is gathered: the integers by
which ancestors are chosen are the same in any order of sums, so decisions are those of one device.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.errors import DeclarationError, MissingDependencyError
from flowgraph.pipeline.pipeline import Cell, Leaf, Pipeline

RUNS = "runs"
"""The axis in front of all, of runs that go together."""


def import_jax() -> Any:
    """The `jax` module.

    Raises:
        MissingDependencyError: with what to install.
    """
    try:
        import jax  # optional
    except ImportError as error:
        raise MissingDependencyError(
            "the XLA engine needs JAX",
            path='engine="xla"',
            expected="an installed jax",
            got=str(error),
            fix='pip install "flowgraph-filters[xla]", or use engine="python"',
        ) from None
    return jax


def chosen_device() -> str:
    """What `jax.default_device` names now, as a key: a scan is compiled for one device."""
    return str(import_jax().config.jax_default_device)


class Devices:
    """A mesh of the first devices of the chosen kind, for one pipeline.

    Args:
        pipeline: whose registers and ports are cut.
        shard: how many devices share each axis.

    Raises:
        DeclarationError: for an axis that the pipeline does not have, or that cannot be cut into equal parts;
            where there are fewer devices.
    """

    def __init__(self, pipeline: Pipeline, shard: Mapping[str, int]) -> None:
        _check_axes(pipeline, shard)
        there = enough_devices(shard)
        self._sharding = import_jax().sharding
        self._shard = dict(shard)
        self._mesh = self._sharding.Mesh(np.array(there).reshape(*shard.values()), tuple(shard))

    def rounded(self, runs: int) -> int:
        """So many runs, or a few more, that each device has as many."""
        share = self._shard.get(RUNS, 1)
        return -(-runs // share) * share

    def placed(self, parts: Sequence[Cell | Leaf], *before: str | None) -> tuple[Any, ...]:
        """Where each of these arrays lies, with axes of these names before its own."""
        return tuple(self.at(*before, *(part.axes or (None,) * len(part.shape))) for part in parts)

    def at(self, *names: str | None) -> Any:
        """Where an array lies whose first axes have these names: whole on all devices without any."""
        cut = (name if name in self._shard else None for name in names)
        return self._sharding.NamedSharding(self._mesh, self._sharding.PartitionSpec(*cut))


def enough_devices(shard: Mapping[str, int]) -> list[Any]:
    """The devices that share the work, of the kind that is chosen.

    Raises:
        DeclarationError: where there are fewer.
    """
    there = _there(import_jax())
    wanted = math.prod(shard.values())
    if wanted > len(there):
        kind = there[0].platform
        more = f"; XLA_FLAGS=--xla_force_host_platform_device_count={wanted}, set before JAX is imported, "
        raise DeclarationError(
            "there are not so many devices",
            path="shard",
            expected=f"{len(there)} or fewer, as many as JAX has of the kind {kind}",
            got=f"{dict(shard)}, which is {wanted}",
            fix="ask for fewer" + (f"{more}makes so many of a processor" if kind == "cpu" else ""),
        )
    return there[:wanted]


def on_processor() -> bool:
    """Whether the devices of the chosen kind are processors."""
    return bool(_there(import_jax())[0].platform == "cpu")


def _there(jax: Any) -> list[Any]:
    """The devices of the kind that is chosen."""
    chosen = jax.config.jax_default_device
    found: list[Any] = jax.devices(chosen if chosen is None else getattr(chosen, "platform", str(chosen)))
    return found


def _check_axes(pipeline: Pipeline, shard: Mapping[str, int]) -> None:
    cells = [c for r in pipeline.registers for c in r.cells]
    leaves = [leaf for port in (*pipeline.inputs, *pipeline.outputs) for leaf in port.leaves]
    sizes: dict[str, set[int]] = {}
    shaped = [(part.shape, part.axes) for part in cells] + [(part.shape, part.axes) for part in leaves]
    for shape, axes in shaped:
        for size, name in zip(shape, axes, strict=False):
            if name is not None:
                sizes.setdefault(name, set()).add(size)
    for name, devices in shard.items():
        if name == RUNS:
            continue
        if name not in sizes:
            raise DeclarationError(
                "the graph has no axis of this name to share out",
                path=f"shard, {pipeline.name}",
                expected=" or ".join(sorted({RUNS, *sizes})),
                got=name,
                fix='name runs, of many, or an axis that the types of the graph name, such as "particles"',
            )
        for size in sorted(sizes[name]):
            if size % devices:
                fewer = max(d for d in range(1, devices) if size % d == 0)
                raise DeclarationError(
                    f"{size} {name} are not shared out evenly",
                    path=f"shard, {pipeline.name}",
                    expected=f"a multiple of {devices}",
                    got=str(size),
                    fix=f"build the graph with {-(-size // devices) * devices}, or ask for {fewer}",
                )
