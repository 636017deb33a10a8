"""Write docs/results/speed.md.

Numbers come from the measurements of every device, or are cited.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks.sim.speed import campaign, roofline, work
from benchmarks.sim.speed.campaign import REFERENCE_FILE, presses_file, steps_file
from benchmarks.sim.speed.candidates import Candidate, cheapest, offers_of, save_offer_chart
from benchmarks.sim.speed.forces import SHALLOW_MM, Errors, Forces, errors, read_forces, read_runs
from benchmarks.sim.speed.record import Machine, Run, SpeedRecord
from benchmarks.sim.speed.steps import AS_IT_IS, READ_HALF, STEPS, Step, steps_on
from recorder.pages import render
from sim.fem import FOR_EDGES
from sim.paper_presses import DEPTHS_MM, FRICTION, PLACES_MM
from sim.tolerance import left_of_difference

# Goals for total seconds and force error, by kind of device: required, and stretch goals.
GOALS = {"cpu": ((600.0, 0.03), (300.0, 0.01)), "gpu": ((10.0, 0.01), (3.0, 0.01))}
WHOLE, DENSE = 162, 810
# Chart, in the folder `images` next to the page.
CHART = "speed.png"
# Shown in place of a value.
MISSING = "not measured"


@dataclass(frozen=True, slots=True)
class Device:
    """Measurements of one device."""

    record: SpeedRecord
    presses: Run
    """All presses, or an empty run."""
    candidates: Sequence[Candidate]
    deep: Errors
    all: Errors
    """Errors of all presses: from `SHALLOW_MM` on, and at all depths."""
    base: Run | None
    """The presses on which steps were left out, with all steps."""
    steps: Sequence[Step]
    """Steps that the device has, or had when they were measured."""
    off: dict[str, float]
    """Mean error without each step."""

    @property
    def machine(self) -> Machine:
        """Its machine."""
        return self.record.machine


def write_page(path: Path, records: Sequence[SpeedRecord]) -> None:
    """Write the page at `path` from the records of one folder."""
    folder = records[0].path.parent
    reference = read_forces(folder / REFERENCE_FILE)
    devices = [_device(record, reference) for record in records]
    bound = _left_in_reference(devices)
    candidates = [one.candidates for one in devices]
    save_offer_chart(path.parent / "images" / CHART, records, candidates, bound)
    solved = [(one.record.get("reference", "reference"), one.machine.name) for one in devices]
    found, name = next((each for each in solved if each[0] is not None), (None, ""))
    columns = [_floor_column(record) for record in records]
    text = render(
        Path(__file__).with_suffix(".md"),
        devices=devices,
        folder=folder,
        chart=CHART,
        bound=bound,
        reference=found,
        reference_machine=found and (found.machine or name),
        floor=[(name, cells) for name, *cells in zip(_FLOOR, *columns, strict=True)],
        goals=GOALS,
        reached=_reached,
        scaled=_scaled,
        campaign=campaign,
        roofline=roofline,
        work=work,
        places=[f"{place:g}" for place in PLACES_MM],
        depths=[f"{depth:g}" for depth in DEPTHS_MM],
        friction=FRICTION,
        finer=FOR_EDGES.finer,
        whole=WHOLE,
        dense=DENSE,
        shallow=SHALLOW_MM,
        seconds=seconds,
        percent=percent,
        memory=memory,
        or_missing=or_missing,
        missing=MISSING,
        nan=math.nan,
        isfinite=math.isfinite,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def _device(record: SpeedRecord, reference: Forces) -> Device:
    forces = read_forces(presses_file(record.path))
    known = steps_on(record.machine.device)
    return Device(
        record,
        record.get("presses", "all") or Run("presses", "all"),
        offers_of(record, reference),
        errors(forces, reference, from_mm=SHALLOW_MM),
        errors(forces, reference),
        record.get("steps", AS_IT_IS),
        [step for step in STEPS if step in known or record.get("steps", step.name)],
        {
            name: errors(each, reference, from_mm=SHALLOW_MM).mean
            for name, each in read_runs(steps_file(record.path)).items()
        },
    )


def _reached(candidates: Sequence[Candidate], limit: float, error: float) -> str:
    """Return whether a goal was reached and by which mesh, or the nearest result."""
    whole = [one for one in candidates if one.presses >= WHOLE and math.isfinite(one.errors.mean)]
    if not whole:
        return MISSING
    best = cheapest(whole, error)
    if best is None:
        near = min(whole, key=lambda one: one.errors.mean)
        failed = f", {near.failed} without a solution" if near.failed else ""
        return f"no: {percent(near.errors.mean)} at best ({near.elements}{failed})"
    answer = "yes" if best.seconds <= limit else "no"
    return f"{answer}: {seconds(best.seconds)}, {percent(best.errors.mean)} ({best.elements})"


def _left_in_reference(devices: Sequence[Device]) -> float:
    """Return the mean error of the reference, by the law of `sim.tolerance`."""
    runs = [one.record.get("reference", "reference") for one in devices]
    run = next((run for run in runs if run), None)
    finest = min(
        (
            one
            for each in devices
            if each.machine.device != "cpu"
            for one in each.candidates
            if one.coarser_mm is None and math.isfinite(one.errors.mean)
        ),
        key=lambda one: one.spacing_mm,
        default=None,
    )
    if run is None or finest is None:
        return math.nan
    return finest.errors.mean * left_of_difference(finest.spacing_mm / run.spacing_mm)


def _scaled(record: SpeedRecord, count: int) -> tuple[Run | None, int]:
    """Return the run of a number of presses, and the number it was predicted from, or 0."""
    whole = record.get("presses", "all")
    run = whole if count == WHOLE else record.get("scaling", str(count))
    if count != DENSE or run or whole is None or not whole.presses:
        return run, 0
    predicted = replace(whole, presses=count, seconds=whole.press_seconds * count, again=math.nan)
    return predicted, whole.presses


# Rows of the table of the roofline bound.
_FLOOR = (
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


def _floor_column(record: SpeedRecord) -> list[str]:
    run, machine = record.get("presses", "all"), record.machine
    if run is None:
        return [MISSING] * len(_FLOOR)
    # Products of the measured runs read the tangent in float16.
    half = machine.device != "cpu" or record.get("steps", READ_HALF) is not None
    bound = roofline.bound_of(run, machine, half=half)
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


def or_missing(value: float, text: str) -> str:
    """Return `text`, or a placeholder for a value that was not measured."""
    return text if math.isfinite(value) else MISSING


def percent(value: float) -> str:
    """Return a fraction in percent."""
    return or_missing(value, f"{100 * value:.2f} %")


def memory(size: int) -> str:
    """Return a number of bytes in MiB."""
    return f"{size / 2**20:,.0f} MiB" if size else MISSING


def seconds(value: float) -> str:
    """Return seconds with three digits, or minutes or hours for long times."""
    if not math.isfinite(value):
        return MISSING
    if value < 120:
        return f"{value:.3g} s"
    return f"{value / 60:.1f} min" if value < 7200 else f"{value / 3600:.1f} h"
