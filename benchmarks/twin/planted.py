"""Sensors with random skins, and tracks as a bench would record them."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from sim.fem import FOR_EDGES, Fem
from sim.indenters import Indenter, named
from sim.result import ContactTier
from sim.sensors import SimulatedSensor, sensor
from sim.sensors.quantities import with_quantities
from sim.stream import LivePress
from sim.tiers import simulate
from sim.twin import PressTrack, track_of
from sim.twin.model import leaning, motion_of, printed
from sim.twin.plan import PlannedPresses, planned_presses

Array = NDArray[np.float64]

# Indenters that identify a twin: each is pressed to two depths, sheared and held.
GAUGE = ("sphere", "prism")
# First of the two depths over the deepest of the row: a thick pad is pressed less deep.
PART, PARTS = 0.4, {"tacpalm": 0.24}
# Rate of poses and forces [Hz], and of solutions while the tip moves.
RATE, SOLVED = 200.0, 50.0
# Solutions of one hold.
HELD = 24
# By `fem` the rate of solutions and those of one hold are a sixth.
FEWER = 6
# Mesh of these, as in archives.
FEM = Fem(spacing=0.8e-3, grading=FOR_EDGES)


@dataclass(frozen=True, slots=True)
class Bench:
    """Errors of a bench, which the fit does not know."""

    noise: float = 0.01
    """Standard deviation of each sample of force [N]."""
    height: float = 0.0
    """Height of the surface above where the bench takes it to be [m]."""
    compliance: float = 0.0
    """Yielding of arm and mount [m/N]."""
    latency: float = 0.0
    """Time by which forces are late [s]."""
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation of the gauge against the pad [rad]."""
    tilt: tuple[float, float] = (0.0, 0.0)
    """Tilt of the pad about x and y [rad]."""
    place: tuple[float, float] = (0.0, 0.0)
    """Place of the tip from where the bench takes it to be [m]."""
    size: float = 0.0
    """Width of the indenter over that of its drawing [m]."""


@dataclass(frozen=True, slots=True)
class Truth:
    """Tier, grid, mesh and device of true forces."""

    tier: ContactTier = "layer"
    grid: int = 96
    """Pixels of the body's longer side, in tier `layer`."""
    fem: Fem = FEM
    """Mesh and tolerances of tier `fem`."""
    device: str = "cpu"
    """Device of tier `fem`."""


LAYER = Truth()


def observed(
    skin: SimulatedSensor, presses: PlannedPresses, bench: Bench, seed: int, truth: Truth = LAYER
) -> PressTrack:
    """Return the track that a bench would record; SimulationDiverged if a press has no solution."""
    time, tip, force = recorded(presses, bench, seed, *solved(skin, presses, bench, truth))
    track = track_of(presses.indenter, presses.indenter, time, tip, time, force)
    assert track is not None
    return track


def recorded(
    presses: PlannedPresses, bench: Bench, seed: int, solutions: Array, forces: Array
) -> tuple[Array, Array, Array]:
    """Return times (n,) [s], tips (n, 3) [m] and forces (n, 3) [N] that a bench would record.

    `solutions` are the times (m,) [s] of the true `forces` (m, 3) [N], `seed` that of the noise.
    """
    corners, tips = presses.path()
    time = np.arange(0.0, corners[-1], 1 / RATE)
    late = along(time - bench.latency, solutions, forces)
    turned = late + np.cross(np.array(bench.turn), late)
    noise = np.random.default_rng(seed).normal(0.0, bench.noise, late.shape)
    return time, along(time, corners, tips), turned + noise


def along(at: Array, time: Array, values: Array) -> Array:
    """Return values (n, 3) at some times (n,), from those (m, 3) at others (m,)."""
    return np.stack([np.interp(at, time, axis) for axis in values.T], axis=1)


def solved(
    skin: SimulatedSensor, presses: PlannedPresses, bench: Bench, truth: Truth = LAYER
) -> tuple[Array, Array]:
    """Return the times of solutions (n,) [s] and a skin's forces (n, 3) [N], without a gauge."""
    time, tip = solutions(presses, FEWER if truth.tier == "fem" else 1)
    return time, felt(skin, named(presses.indenter), time, tip, bench, truth)


def solutions(presses: PlannedPresses, fewer: int = 1) -> tuple[Array, Array]:
    """Return times (n,) [s] and tips (n, 3) [m] of solutions, or of fewer by a factor."""
    corners, tips = presses.path()
    times, places = [0.0], [tips[0]]
    for leg in range(1, len(corners)):
        start, stop = corners[leg - 1], corners[leg]
        held = not np.any(tips[leg] != tips[leg - 1])
        count = HELD // fewer if held else max(2, round((stop - start) * SOLVED / fewer))
        fractions = np.arange(1, count + 1) / count
        for fraction in np.square(fractions) if held else fractions:
            places.append(tips[leg - 1] + fraction * (tips[leg] - tips[leg - 1]))
            times.append(start + fraction * (stop - start))
    return np.array(times), np.array(places)


def felt(
    skin: SimulatedSensor,
    indenter: Indenter,
    time: Array,
    tip: Array,
    bench: Bench,
    truth: Truth = LAYER,
    *,
    every: int = 1,
) -> Array:
    """Return the forces on a skin (n, 3) [N] where a bench takes the tip (n, 3) [m] to be.

    The indenter is as drawn. Steps between times (n,) [s] are short, for the mount yields by the
    last force, that of tier `layer` also in tier `fem`. Of points, every `every`th has its force
    returned, beginning with the first.
    """
    indenter, seen = leaning(
        printed(indenter, bench.size), tip + np.array([*bench.place, 0.0]), bench.tilt
    )
    seen[:, 2] -= bench.height
    if truth.tier == "layer" or bench.compliance:
        press = pressed(skin, indenter, time, seen, truth.grid, bench.compliance)
        forces = np.array([force_of(each) for each in press])
    if truth.tier == "layer":
        return forces[::every]
    scene = skin.scene(indenter, motion_of(seen[::every], time[::every]))
    return np.asarray(simulate(scene, truth.fem, device=truth.device).wrench[:, :3], float)


def pressed(
    skin: SimulatedSensor,
    indenter: Indenter,
    time: Array,
    tip: Array,
    grid: int,
    compliance: float = 0.0,
) -> Iterator[LivePress]:
    """Yield a press of tier `layer` at each time (n,) [s].

    The tip (n, 3) [m] is raised in place as the mount yields by the force before.
    """
    press = LivePress(skin, indenter, grid=grid, tolerance=2e-3)
    yield press
    for row in range(1, len(time)):
        tip[row, 2] -= compliance * force_of(press)[2]
        press.move(tip[row], time[row] - time[row - 1])
        yield press


def force_of(press: LivePress) -> Array:
    """Return the force of a press (3,) [N]; 0 without contact."""
    return np.asarray(press.force, float) if press.touching else np.zeros(3)


def random_skin(random: np.random.Generator, base: str) -> tuple[SimulatedSensor, Bench]:
    """Return a skin that differs from the row `base`, and the errors of a bench."""
    design = replace(sensor(base), trajectory=None, force_depth=None)
    viscosity = design.effects.viscosity
    assert viscosity is not None
    values: Mapping[str, float] = {
        "modulus": design.body.modulus * np.exp(random.uniform(-0.7, 0.7)),
        "thickness": design.body.thickness * np.exp(random.uniform(-0.2, 0.2)),
        "poisson": random.uniform(0.43, 0.47),
        "friction": np.exp(random.uniform(np.log(0.3), np.log(0.9))),
        **{
            f"ratio_{index}": ratio * np.exp(random.uniform(-0.6, 0.6))
            for index, ratio in enumerate(viscosity.ratios, 1)
        },
        **{
            f"time_{index}": time * np.exp(random.uniform(-0.3, 0.3))
            for index, time in enumerate(viscosity.times, 1)
        },
    }
    bench = Bench(
        height=random.normal(0.0, 30e-6),
        compliance=abs(random.normal(0.0, 3e-6)),
        latency=random.uniform(0.0, 8e-3),
        turn=tuple(random.normal(0.0, 0.015, 3).tolist()),
        tilt=tuple(random.normal(0.0, 0.01, 2).tolist()),
    )
    return with_quantities(design, values), bench


def usual(indenter: str, name: str) -> PlannedPresses:
    """Return presses to two depths of a design, sheared and held; the second is twice as deep."""
    step = round(PARTS.get(name, PART) * sensor(name).depth_max, 5)
    return planned_presses(indenter, (step, 2 * step), 0.8e-3, 1.6)
