"""Tables of the page on the gain of each optimisation, and on the roofline bound."""

from __future__ import annotations

import math
from collections.abc import Sequence

from benchmarks.sim.speed.campaign import steps_file
from benchmarks.sim.speed.cells import MISSING, or_missing, percent, row, seconds
from benchmarks.sim.speed.forces import SHALLOW_MM, Forces, errors, read_runs
from benchmarks.sim.speed.record import Run, SpeedRecord
from benchmarks.sim.speed.roofline import (
    CG_BYTES,
    HALF_ROW_BYTES,
    WHOLE_CG_BYTES,
    bound_of,
    newton_element_bytes,
    newton_element_flops,
)
from benchmarks.sim.speed.steps import (
    AS_IT_IS,
    READ_HALF,
    REPLACED,
    STEPS,
    Step,
    assembled_gain,
    steps_on,
)

_STEPS = """
## Gain of each step

Ablation: one step left out at a time, on presses in the middle: all indenters on a GPU, four on a
CPU, in one process. Gain: time without the step over time with it. Forces: mean distance from those
with all steps. Error: relative to the reference, mean over depths from {deep:g} mm on.
"""
_FLOOR = """
## Roofline bound

The roofline bound counts Newton iterations, elements, nodes and CG iterations of each press of the
timed run. A CG iteration moves at least {cg} bytes per node if products read the tangent in float16
({row} for its row, the rest for vectors and preconditioner in float32), and {whole} if they read it
in float32. A Newton iteration moves {element:g} bytes per element besides writing and copying the
tangent, and computes {flops:,.0f} operations per element, counted in the kernels' source; on a CPU,
where every second one assembles the elastic part, {cpu_element:g} and {cpu_flops:,.0f}. Bytes are
moved at the copy rate measured next to the run, for an array larger than any cache or, on a CPU
where that is faster, for one as large as the tangent of one press.
"""


def steps_section(records: Sequence[SpeedRecord], reference: Forces) -> list[str]:
    """Return the predicted and measured gain of each step, a table for each device."""
    lines = [_STEPS.format(deep=SHALLOW_MM)]
    for record in records:
        base = record.get("steps", AS_IT_IS)
        runs = read_runs(steps_file(record.path))
        off = {
            name: errors(forces, reference, from_mm=SHALLOW_MM).mean
            for name, forces in runs.items()
        }
        lines += [
            "",
            f"**{record.machine.name}**"
            + (f", {base.presses} presses in {seconds(base.seconds)}" if base else ""),
            "",
            "| step | predicted gain | why | measured gain | seconds without, with | "
            "Newton, CG without (with) | elements without (with) | forces | error without (with) |",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        lines += [_step_line(step, record, base, off) for step in STEPS if _shown(step, record)]
        if record.machine.device != "cpu":
            lines += _warm_start(record)
            continue
        for old in REPLACED:
            lines.append(
                f"| {old.name} | {old.predicted} | {old.reason} | "
                f"{_once(old.measured, record, old is REPLACED[0])} | - | - | - | - | - |"
            )
        lines += _warm_start(record)
    return lines


def _shown(step: Step, record: SpeedRecord) -> bool:
    """Return True if the device has the step, or had it when it was measured."""
    return step in steps_on(record.machine.device) or record.get("steps", step.name) is not None


def _read_half(record: SpeedRecord) -> bool:
    """Return True if products of the measured runs read the tangent in float16."""
    return record.machine.device != "cpu" or record.get("steps", READ_HALF) is not None


def _warm_start(record: SpeedRecord) -> list[str]:
    """Return the upper bound on the gain of a start from `layer`."""
    run = record.get("presses", "all")
    if run is None or not run.newton or not math.isfinite(run.newton_first):
        return []
    most = percent(max(run.newton_first, 0.0) / run.newton)
    return [
        "",
        "Not built: a warm start from `layer`. Every depth but the first starts from a prediction; "
        f"the first takes {run.newton_first / run.presses:.1f} Newton iterations a press more, "
        f"{most} of all: this is an upper bound on the saving, and `layer` takes time as well.",
    ]


def _once(measured: str, record: SpeedRecord, tangent: bool) -> str:
    """Return the gain measured when both variants existed, and its value for the present run."""
    run = record.get("presses", "all")
    text = f"measured once: {measured}"
    if tangent and run is not None and run.cg_nodes:
        gain = assembled_gain(run.newton_elements, run.cg_nodes)
        text += f"; {gain:.1f} with this run's iterations"
    return text


def _step_line(step: Step, record: SpeedRecord, base: Run | None, off: dict[str, float]) -> str:
    run = record.get("steps", step.name)
    cells = [step.title or step.name, step.predicted, step.reason]
    if run is None or base is None:
        return row([*cells, *[MISSING] * 6])
    pair = (run.against, run.seconds) if step.put_in else (run.seconds, run.against)
    failed = f", {run.failed} without a solution" if run.failed else ""
    cells += [
        f"{pair[0] / pair[1]:.2f}{failed}",
        f"{seconds(pair[0])}, {seconds(pair[1])}",
        f"{run.newton:,}, {run.cg:,} ({base.newton:,}, {base.cg:,})",
        f"{run.elements:,} ({base.elements:,})",
        percent(run.difference),
        f"{percent(off.get(step.name, math.nan))} ({percent(off.get(AS_IT_IS, math.nan))})",
    ]
    return row(cells)


def floor_section(records: Sequence[SpeedRecord]) -> list[str]:
    """Return the roofline bound of the timed presses, one column per device."""
    lines = [
        _FLOOR.format(
            cg=CG_BYTES,
            row=HALF_ROW_BYTES,
            whole=WHOLE_CG_BYTES,
            element=newton_element_bytes(cpu=False),
            flops=newton_element_flops(cpu=False),
            cpu_element=newton_element_bytes(cpu=True),
            cpu_flops=newton_element_flops(cpu=True),
        ),
        "| | " + " | ".join(record.machine.name for record in records) + " |",
        "|---|" + "---|" * len(records),
    ]
    columns = [_floor_column(record) for record in records]
    names = (
        "Newton, CG iterations",
        "elements, nodes, mesh groups",
        "tangent read in",
        "bytes: Newton, CG",
        "operations",
        "copy: far, near",
        "float32 operations a second",
        "seconds for bytes, operations",
        "bound",
        "measured",
        "measured / bound",
    )
    for index, name in enumerate(names):
        lines.append(row([name, *(column[index] for column in columns)]))
    return lines


def _floor_column(record: SpeedRecord) -> list[str]:
    run, machine = record.get("presses", "all"), record.machine
    if run is None:
        return [MISSING] * 11
    half = _read_half(record)
    bound = bound_of(run, machine, half=half)
    rate = or_missing(machine.flop_rate, f"{machine.flop_rate:.3g} ({machine.flop_source})")
    return [
        f"{run.newton:,}, {run.cg:,}",
        f"{run.elements:,}, {run.nodes:,}, {run.groups}",
        "float16" if half else "float32",
        f"{bound.newton_bytes / 1e9:.3g} GB, {bound.cg_bytes / 1e9:.3g} GB",
        f"{bound.flops / 1e9:.3g} G",
        or_missing(
            machine.copy_rate,
            f"{machine.copy_rate / 1e9:.3g} GB/s, {machine.near_rate / 1e9:.3g} GB/s",
        ),
        rate,
        f"{seconds(bound.byte_seconds)}, {seconds(bound.flop_seconds)}",
        seconds(bound.seconds),
        seconds(run.best),
        or_missing(bound.seconds, f"{run.best / bound.seconds:.1f}" if bound.seconds else MISSING),
    ]
