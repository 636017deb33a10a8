"""Pads of two kinds with planted skins, pressed at the same places on a bench with errors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from benchmarks.twin.planted import GAUGE, Bench, Truth, along, felt, observed, random_skin, usual
from recorder.archive import ArchivedSensor, Simulated
from sim.dataset import DatasetPlan
from sim.dataset.plan import PlannedPress, code, target_presses
from sim.fem import Fem
from sim.indenters import NAMES, indenter_of
from sim.result import ContactTier
from sim.sensors import SimulatedSensor, sensor
from sim.sensors.quantities import with_quantities
from sim.twin import fitted
from sim.twin.labels import provenance, simulated_forces

Array = NDArray[np.float64]

SENSORS = ("gelsight", "tacpalm")
# Fields of `Bench` that each error sets.
ALL = ("place", "tilt", "height", "size", "compliance")
ERRORS = {"none": (), **{error: (error,) for error in ALL}, "all": ALL}
# Largest place [m], tilt [rad], height [m], size [m] and the compliance [m/N].
PLACE, TILT, HEIGHT, SIZE, COMPLIANCE = 0.3e-3, math.radians(1.0), 30e-6, 0.1e-3, 20e-6
# Frames per phase, and steps of the arm from frame to frame while its mount yields.
STEPS, BETWEEN = 2, 10
# Fraction of a plan's targets among which those of a draw are chosen.
TARGETS = 1 / 8
# Deepest press of each sensor [m].
DEEPEST = {"gelsight": 1.0e-3, "tacpalm": 2.25e-3}
SEED = 0
# Coarse elements and tolerances, for many presses.
FEM = Fem(fineness=0.4, elements_max=2500, augmentations=1, tolerance=1e-3, path_tolerance=1e-2)


# Indenters and pixels of twins and labels, of a complete run and of a quick one.
INDENTERS = (("sphere_s", "hemisphere", "cylinder", "torus"), ("sphere", "torus"))
GRIDS = (48, 24)


@dataclass(frozen=True, slots=True)
class Pad:
    """Sensor with the skin of a draw, on a bench."""

    name: str
    draw: int
    quick: bool
    """True forces by `layer`; its twin is the skin with a thickness 5 % too large."""
    device: str

    @property
    def skin(self) -> SimulatedSensor:
        """The skin, which differs from its row."""
        seed = [SEED, self.draw, SENSORS.index(self.name)]
        return random_skin(np.random.default_rng(seed), self.name)[0]

    @property
    def truth(self) -> Truth:
        """Settings of its true forces."""
        fem = replace(FEM, step_travel=self.skin.body.thickness / 20)
        # Tier `layer` has a finer grid than the twins.
        tier: ContactTier = "layer" if self.quick else "fem"
        return Truth(tier, 2 * GRIDS[self.quick], fem, self.device)

    def bench(self, indenter: str, error: str) -> Bench:
        """Return the bench with one error or all: in a draw, each is the same alone or not."""
        seed = [SEED, self.draw]
        mounted = np.random.default_rng([*seed, SENSORS.index(self.name), code(indenter)])
        printed = np.random.default_rng([*seed, len(SENSORS), code(indenter)])
        most: dict[str, Any] = {
            "place": tuple((PLACE * mounted.uniform(-1, 1, 2)).tolist()),
            "tilt": tuple((TILT * mounted.uniform(-1, 1, 2)).tolist()),
            "height": HEIGHT * mounted.uniform(-1, 1),
            "size": SIZE * printed.uniform(-1, 1),
            "compliance": COMPLIANCE,
        }
        return Bench(**{field: most[field] for field in ERRORS[error]})

    def twin(self, error: str) -> SimulatedSensor:
        """Return the twin fitted to presses of `GAUGE`; SimulationDiverged if one is not solved."""
        if self.quick:
            return with_quantities(self.skin, {"thickness": 1.05 * self.skin.body.thickness})
        tracks = [
            observed(
                self.skin,
                usual(indenter, self.name),
                self.bench(indenter, error),
                number,
                self.truth,
            )
            for number, indenter in enumerate(GAUGE, 100 * self.draw)
        ]
        return fitted(tracks, sensor(self.name), grid=GRIDS[self.quick]).sensor

    def planned(self) -> list[PlannedPress]:
        """Return a press of each indenter, at places of both sensors, and a force-depth press."""
        design, deepest = sensor(self.name), DEEPEST[self.name]
        assert design.force_depth is not None
        assert design.trajectory is not None
        step = deepest / design.trajectory.depth_count
        design = replace(
            design,
            trajectory=replace(design.trajectory, depth_max=deepest, depth_step=step),
            force_depth=replace(design.force_depth, depth_max=deepest, repeats=1),
        )
        indenters = tuple(sorted(INDENTERS[self.quick], key=code))
        plan = DatasetPlan("targets", (design,), indenters, steps=STEPS, fraction=TARGETS)
        *presses, force_depth = target_presses(plan, design)
        each = len(presses) // len(indenters)
        chosen = np.random.default_rng([SEED, self.draw]).permutation(each)
        some = (presses[index * each + chosen[index % each]] for index in range(len(indenters)))
        return [*some, force_depth]

    def force(self, press: PlannedPress, error: str) -> Array:
        """Return the true force at each frame (n, 3) [N]; SimulationDiverged without a solution."""
        count = len(press.motion)
        fine = np.arange((count - 1) * BETWEEN + 1) / BETWEEN
        frames = np.column_stack([press.motion.time, press.motion.tip])
        path = along(fine, np.arange(count, dtype=float), frames)
        return felt(
            self.skin,
            indenter_of(press.indenter),
            path[:, 0],
            path[:, 1:],
            self.bench(press.indenter, error),
            self.truth,
            every=BETWEEN,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pressed:
    """Presses of a sensor as in an archive, without its images."""

    name: str
    table: Mapping[str, np.ndarray[Any, Any]]
    simulated: Simulated | None = None

    def __len__(self) -> int:
        return len(self.table["location"])

    @property
    def archived(self) -> ArchivedSensor:
        """The presses as functions of archives take them."""
        return cast("ArchivedSensor", self)

    def beside(self, twin: SimulatedSensor, grid: int) -> Pressed:
        """Return the presses with a twin's forces, as `tactile sim labels` adds them."""
        found = simulated_forces(self.archived, NAMES, twin, draws=0, seed=0, grid=grid)
        told = provenance(twin, 0, 0, grid)
        return replace(self, simulated=Simulated(found.force, found.spread, told))


def table(press: PlannedPress, force: Array) -> dict[str, np.ndarray[Any, Any]]:
    """Return a press as rows of an archive: they are not valid without a force."""
    (recording,), count = press.recordings, len(force)
    tip = np.array(press.motion.tip)
    return {
        "indenter": np.full(count, code(press.indenter)),
        "location": np.array(recording.locations),
        "target": np.full(count, recording.target),
        "phase": np.array(recording.phases),
        "depth": np.maximum(-tip[:, 2], 0.0),
        "position": tip[:, :2],
        "wrench": np.column_stack([force, np.zeros((count, 3))]),
        "frame": np.arange(count),
        "t_ns": np.round(1e9 * np.array(press.motion.time)).astype(np.int64),
        "valid": np.isfinite(force).all(axis=1),
    }
