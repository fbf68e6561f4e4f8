"""Where modules were before they had rooms: an old name leads to the module that stands in its place.

Programs that were written against earlier versions import some of these. The table is all there is of the old
layout; a name that is imported through it is the same module, not a copy.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec
from types import ModuleType

_ROOMS = {
    "flowgraph.recorder": "ops symbolic symbolic_namespace namespaces random",
    "flowgraph.language": "clock block stream declare builder wiring checks recording graph joins pairs"
    " operations windows timed queues",
    "flowgraph.data": "series inputs result export registry progress",
    "flowgraph.drawing": "draw plot",
    "flowgraph.pipeline": "lowering cut description listing program optimise costs",
    "flowgraph.engines": "reference state pipeline_inputs playback many simulate c",
}
_RENAMED = {
    "flowgraph.draw_text": "flowgraph.drawing.text",
    "flowgraph.plot_attitude": "flowgraph.drawing.attitude",
    "flowgraph.plot_trajectory": "flowgraph.drawing.trajectory",
    "flowgraph.cut_run": "flowgraph.engines.parts",
    "flowgraph.plan": "flowgraph.engines.python.plan",
    "flowgraph.run": "flowgraph.engines.python.run",
    "flowgraph.xla": "flowgraph.engines.xla.scan",
    "flowgraph.xla_batch": "flowgraph.engines.xla.batch",
}
_BLOCKS = {
    "aiding": "inertial.aiding", "alignment": "inertial.alignment", "calibration": "inertial.calibration",
    "imu_calibration": "inertial.imu_calibration", "chi_square": "metrics.chi_square",
    "consistency": "metrics.consistency", "euler": "geometry.euler", "manifold": "geometry.manifold",
    "lanes": "geometry.lanes", "linear": "kalman.linear", "roots": "kalman.roots",
    "smoothing": "kalman.smoothing", "extended": "models.pose", "pose_model": "models.unscented_pose",
    "euler_ins": "models.euler_ins", "point": "models.point", "unscented_ins": "models.unscented_ins",
    "sigma_points": "unscented.sigma_points", "resampling": "particles.resampling",
    "rao_blackwell": "particles.rao_blackwell", "state_particles": "models.particle_ins",
    "plane": "models.plane", "marg": "orientation.marg", "heading": "orientation.heading",
    "complementary": "orientation.complementary", "fixed_gain": "orientation.fixed_gain",
    "outdoor_belief": "outdoor.belief", "outdoor_cloud": "outdoor.cloud", "scores": "scoring.scorer",
    "tuning": "scoring.tuning", "vision.course": "datasets.coursework",
    "datasets.scores": "scoring.orientation",
    "sensors.geodetic": "geometry.geodetic",
}  # fmt: skip

MOVED = {
    **{f"flowgraph.{name}": f"{room}.{name}" for room, names in _ROOMS.items() for name in names.split()},
    **_RENAMED,
    **{f"flowgraph.blocks.{old}": f"flowgraph.blocks.{new}" for old, new in _BLOCKS.items()},
}
"""The new name of each module that was moved, by its old one."""


class _Moved:
    """Finds a module under its old name, and hands out the one under the new name."""

    def __init__(self) -> None:
        self._own: dict[str, ModuleSpec | None] = {}

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        return ModuleSpec(name, self) if self._place(name) else None  # type: ignore[arg-type]  # importlib.abc costs the start 5 ms

    def _place(self, name: str) -> str | None:
        if name in MOVED:
            return MOVED[name]
        parent, _, last = name.rpartition(".")
        moved = self._place(parent) if parent.startswith("flowgraph.") else None
        return f"{moved}.{last}" if moved else None  # such as flowgraph.costs.report

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        place = self._place(spec.name)
        assert place is not None
        module = importlib.import_module(place)
        self._own[spec.name] = module.__spec__
        return module

    def exec_module(self, module: ModuleType) -> None:
        """It has run under its own name, which it keeps."""
        spec = module.__spec__
        assert spec is not None
        module.__spec__ = self._own.pop(spec.name)


class Package(ModuleType):
    """A package in which a module never takes the place of the function of its name.

    To import `flowgraph.graph` would set the attribute `graph`, which is the decorator; so would
    `flowgraph.graphs.ekf` hide the graph.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (isinstance(value, ModuleType) and name in self.__all__):
            super().__setattr__(name, value)


def lead(package: ModuleType) -> None:
    """Let old names lead to the modules, and let `package` keep what it lists in `__all__`."""
    package.__class__ = Package
    sys.meta_path.insert(0, _Moved())  # before files below a package that moved are found a second time
