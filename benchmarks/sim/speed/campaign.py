"""Measure the parts that are not yet in a device's file, one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from benchmarks.sim.speed.forces import (
    Forces,
    errors,
    forces_of,
    read_runs,
    write_forces,
    write_runs,
)
from benchmarks.sim.speed.machine import FAR_BYTES, copy_rate, flop_rate, machine_name
from benchmarks.sim.speed.record import Machine, Run, SpeedRecord, read
from benchmarks.sim.speed.roofline import ROW_BYTES
from benchmarks.sim.speed.steps import AS_IT_IS, steps_on
from benchmarks.sim.speed.timing import Solve, fem, mpm, timed, warm_up, warm_up_mpm
from benchmarks.sim.speed.work import PaperWork, TimedPress

if TYPE_CHECKING:
    from sim.fem import Fem
    from sim.mpm import Mpm

# Settings of the timed presses: residual over force at the depths that are stored and between
# them, and number of multiplier updates. Tighter settings change no mesh's error by 0.1 %; see the
# ablation of this step.
TOLERANCE, PATH_TOLERANCE, AUGMENTATIONS = 1.5e-2, 0.1, 1
# Settings of the reference. With tighter ones the skin creases under sharp edges, where there are
# many solutions, and the solver fails.
REFERENCE_TOLERANCE, REFERENCE_AUGMENTATIONS = 3e-4, 5
# Numbers of presses besides the whole and the dense set.
SCALING = (1, 9)
# Tip speed in the authors' released parameters, with which Tacchi was timed [m/s].
AUTHORS_SPEED = 40e-3
REFERENCE_FILE = "reference.csv"


@dataclass(frozen=True, slots=True)
class SpeedCampaign:
    """Selection and settings of the measurements."""

    device: str
    work: PaperWork
    folder: Path
    parts: tuple[str, ...]
    processes: int
    spacing: float
    """Element height of the timed presses [m]."""
    meshes: tuple[float, ...]
    """Other element heights with which the same presses are timed [m]."""
    reference_spacing: float
    again: bool
    """Measure existing runs again."""
    long: bool
    """On a CPU, also measure 810 presses."""
    kernels: Path | None
    """Warp's cache."""
    mpm: dict[str, Mpm] = field(default_factory=dict)
    """Presets of `mpm` by name, the first our own."""

    @property
    def file(self) -> Path:
        """Record of the device."""
        return self.folder / f"{self.device.replace(':', '-')}.jsonl"

    @property
    def on_gpu(self) -> bool:
        """True if the device solves presses in parallel."""
        return self.device != "cpu"

    @property
    def numerics(self) -> Fem:
        """Settings of the timed presses."""
        from sim.fem import FOR_EDGES, Fem

        return Fem(
            spacing=self.spacing,
            grading=FOR_EDGES,
            tolerance=TOLERANCE,
            path_tolerance=PATH_TOLERANCE,
            augmentations=AUGMENTATIONS,
            one_topology=self.on_gpu,
        )


def presses_file(record: Path) -> Path:
    """Return the file of the forces of the timed presses, next to the record of their device."""
    return record.with_name(f"{record.stem}-presses.csv")


def steps_file(record: Path) -> Path:
    """Return the file of the forces of the ablation runs."""
    return record.with_name(f"{record.stem}-steps.csv")


def meshes_file(record: Path) -> Path:
    """Return the file of the forces of the same presses with other element sizes."""
    return record.with_name(f"{record.stem}-meshes.csv")


def measure(plan: SpeedCampaign, say: Callable[[str], None]) -> None:
    """Measure the requested parts that are not yet in the file, and store each run."""
    record = read(plan.file) if plan.file.exists() else None
    if record is None:
        record = SpeedRecord(plan.file, Machine(machine_name(plan.device), plan.device))
    campaign = _Campaign(plan, record, say)
    known = {
        "presses": campaign.presses,
        "scaling": campaign.scaling,
        "steps": campaign.steps,
        "mpm": campaign.mpm,
        "meshes": campaign.meshes,
        "reference": campaign.reference,
    }
    for part in plan.parts:
        known[part]()


class _Campaign:
    """Measurement of the parts, with their shared state."""

    def __init__(
        self, plan: SpeedCampaign, record: SpeedRecord, say: Callable[[str], None]
    ) -> None:
        self._plan, self._record, self._say = plan, record, say
        self._warm: tuple[float, int] | None = None

    def presses(self) -> None:
        plan = self._plan
        run = self._run("presses", "all", plan.processes)
        if not self._due(run):
            return
        presses = plan.work.presses
        solve = fem(plan.numerics, plan.device, plan.processes)
        run, forces = self._solved(run, presses, solve)
        write_forces(presses_file(plan.file), forces)
        if plan.on_gpu:
            again, _forces = self._solved(run, presses, solve)
            run = replace(run, again=again.seconds)
        self._rate(run)
        self._keep(run)

    def scaling(self) -> None:
        plan = self._plan
        for count in SCALING:
            if count < len(plan.work.presses):
                processes = min(count, plan.processes)
                self._timed("scaling", str(count), plan.work.some(count), processes=processes)
        if plan.on_gpu or plan.long:
            dense = plan.work.dense
            self._timed("scaling", str(len(dense)), dense, processes=plan.processes)

    def steps(self) -> None:
        plan = self._plan
        sample = plan.work.centred if plan.on_gpu else plan.work.sample
        steps = steps_on(plan.device)
        due = [step for step in steps if self._due(self._run("steps", step.name))]
        if not due:
            return
        whole = self._run("steps", AS_IT_IS), sample, fem(plan.numerics, plan.device)
        if plan.on_gpu:  # the first run allocates memory that later ones reuse
            self._solved(*whole)
        # The baseline is timed in the same call, because the machine may have changed.
        base, forces = self._solved(*whole)
        self._keep(base)
        kept = read_runs(steps_file(plan.file)) | {AS_IT_IS: forces}
        for step in due:
            processes = plan.processes if step.put_in else 1
            solve = step.solve(plan.numerics, plan.device, plan.processes)
            run, found = self._solved(self._run("steps", step.name, processes), sample, solve)
            kept[step.name] = found
            write_runs(steps_file(plan.file), kept)
            off = errors(found, forces).mean
            self._keep(replace(run, difference=off, against=base.seconds))

    def mpm(self) -> None:
        plan = self._plan
        sphere = plan.work.centred[_place_of(plan.work.centred, "sphere")]
        for name, numerics in plan.mpm.items():
            speed = AUTHORS_SPEED if "authors" in name else 10e-3
            self._mpm(f"{name}, 1 press", [sphere], numerics, speed)
        if plan.on_gpu:
            for name, numerics in list(plan.mpm.items())[:1]:
                count = len(plan.work.centred)
                self._mpm(f"{name}, {count} presses", plan.work.centred, numerics, 10e-3)

    def meshes(self) -> None:
        plan = self._plan
        for spacing in plan.meshes:
            run = replace(
                self._run("meshes", f"{spacing * 1e3:.3g} mm", plan.processes),
                spacing_mm=spacing * 1e3,
            )
            if not self._due(run):
                continue
            solve = fem(replace(plan.numerics, spacing=spacing), plan.device, plan.processes)
            run, forces = self._solved(run, plan.work.presses, solve)
            path = meshes_file(plan.file)
            write_runs(path, read_runs(path) | {run.name: forces})
            self._keep(run)

    def reference(self) -> None:
        plan = self._plan
        run = replace(
            self._run("reference", "reference", plan.processes),
            spacing_mm=plan.reference_spacing * 1e3,
            tolerance=REFERENCE_TOLERANCE,
            note=f"tolerance {REFERENCE_TOLERANCE:g}, {REFERENCE_AUGMENTATIONS} augmentations",
        )
        if not self._due(run):
            return
        presses = plan.work.reference
        numerics = replace(
            plan.numerics,
            spacing=plan.reference_spacing,
            tolerance=REFERENCE_TOLERANCE,
            path_tolerance=None,
            augmentations=REFERENCE_AUGMENTATIONS,
        )
        run, forces = self._solved(run, presses, fem(numerics, plan.device, plan.processes))
        write_forces(plan.folder / REFERENCE_FILE, forces)
        self._keep(run)

    def _run(self, part: str, name: str, processes: int = 1) -> Run:
        return Run(
            part,
            name,
            processes=processes,
            spacing_mm=self._plan.spacing * 1e3,
            tolerance=self._plan.numerics.tolerance,
        )

    def _due(self, run: Run) -> bool:
        """Return True if the run still has to be measured."""
        known = self._record.get(*run.key)
        if known is None or self._plan.again:
            return True
        self._say(f"{run.part}, {run.name}: already measured; --again measures it again")
        return False

    def _timed(
        self, part: str, name: str, presses: Sequence[TimedPress], *, processes: int
    ) -> None:
        run = self._run(part, name, processes)
        if self._due(run):
            solve = fem(self._plan.numerics, self._plan.device, processes)
            self._keep(self._solved(run, presses, solve)[0])

    def _solved(self, run: Run, presses: Sequence[TimedPress], solve: Solve) -> tuple[Run, Forces]:
        """Solve presses by finite elements and return the measured `run` and their forces."""
        plan = self._plan
        if self._warm is None:
            scene = presses[0].scene()
            self._warm = warm_up(scene, plan.numerics, plan.device, plan.kernels)
            self._say(f"first presses: {self._warm[0]:.1f} s, {self._warm[1]} modules compiled")
            machine = self._record.machine
            if not machine.warm_seconds >= self._warm[0]:
                seconds, compiled = self._warm
                self._record.machine = replace(machine, warm_seconds=seconds, compiled=compiled)
        measured, outcomes = timed(run, [one.scene() for one in presses], solve, plan.device)
        return measured, forces_of(presses, outcomes)

    def _mpm(self, name: str, presses: Sequence[TimedPress], numerics: Mpm, speed: float) -> None:
        plan = self._plan
        spacing = (numerics.cell or 0.5e-3) * 1e3
        run = replace(self._run("mpm", name), spacing_mm=spacing, tolerance=math.nan)
        if not self._due(run):
            return
        scenes = [one.scene(speed=speed) for one in presses]
        warm_up_mpm(scenes[0], numerics, plan.device)
        self._keep(timed(run, scenes, mpm(numerics, plan.device), plan.device)[0])

    def _rate(self, run: Run) -> None:
        """Measure the rates of the machine, next to the run to which they apply."""
        plan = self._plan
        near = max(ROW_BYTES * run.nodes // max(run.presses, 1), 2**20)
        flops, source = flop_rate(plan.device)
        self._record.machine = replace(
            self._record.machine,
            copy_rate=copy_rate(plan.device, FAR_BYTES, plan.processes),
            near_rate=copy_rate(plan.device, near, plan.processes),
            flop_rate=flops,
            flop_source=source,
        )

    def _keep(self, run: Run) -> None:
        self._record.put(run)
        failed = f", {run.failed} without a solution" if run.failed else ""
        count = "1 press" if run.presses == 1 else f"{run.presses} presses"
        self._say(f"{run.part}, {run.name}: {count} in {run.seconds:.3g} s{failed}")


def _place_of(presses: Sequence[TimedPress], indenter: str) -> int:
    return [press.indenter for press in presses].index(indenter)
