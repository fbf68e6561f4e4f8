"""A pipeline as text that a hardware engineer reads top to bottom."""

from __future__ import annotations

from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction


def listing(pipeline: Pipeline) -> str:
    """Ports, registers, then stages with one instruction a line."""
    lines = [f"pipeline {pipeline.name}", ""]
    for title, ports in (("input", pipeline.inputs), ("output", pipeline.outputs)):
        for port in ports:
            lines.append(f"{title} {port.name}: {port.type}, present = %{port.present}   [{port.clock}]")
            for leaf in port.leaves:
                more = "".join(f", {p}" for p in (leaf.unit, leaf.frame) if p)
                lines.append(f"    %{leaf.value:<5} {leaf.name}: {_spec(Spec(leaf.shape, leaf.dtype))}{more}")
    for host in pipeline.host:
        streams = f", feeds {', '.join(host.feeds)}" if host.feeds else ""
        streams += f", reads {', '.join(host.reads)}" if host.reads else ""
        lines.append(f"on the host, {host.side}: {host.path} ({host.block}){streams}  # {host.line}")
    lines.append("")
    for register in pipeline.registers:
        lines.append(f"register {register.path} ({register.role})")
        for cell in register.cells:
            lines.append(
                f"    %{cell.read:<5} {cell.name}: {_spec(Spec(cell.shape, cell.dtype))} <- %{cell.write}"
            )
    lines.append("")
    for stage in pipeline.stages:
        lines.append(f"stage {stage.path} ({stage.block}), enabled by %{stage.enable}")
        lines.extend(f"    {instruction(i)}" for i in stage.instructions)
    lines += ["", *(f"{name}: {value}" for name, value in pipeline.totals().items())]
    return "\n".join(lines) + "\n"


def instruction(i: Instruction) -> str:
    """`%12 = matmul(%3, %7): real[3]  # module:line`."""
    args = ", ".join([*(f"%{a}" for a in i.args), *(f"{k}={v}" for k, v in i.attrs.items())])
    return f"%{i.out:<5} = {i.op}({args}): {_spec(i.spec)}".ljust(72) + f"  # {i.line}"


def _spec(spec: Spec) -> str:
    return spec.dtype + (f"[{','.join(map(str, spec.shape))}]" if spec.shape else "")
