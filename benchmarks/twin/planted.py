"""Sensors with random skins, and tracks as a bench would record them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.fem import FOR_EDGES, Fem
from sim.indenters import Indenter, Part, named
from sim.result import ContactTier
from sim.scene import Motion
from sim.sensors import SimulatedSensor, SurfaceField, sensor
from sim.sensors.quantities import with_quantities
from sim.stream import LivePress
from sim.tiers import simulate
from sim.twin import PressTrack, track_of
from sim.twin.model import leaning
from sim.twin.plan import PlannedPresses, planned_presses

Array = NDArray[np.float64]

# Pixels of the body's longer side in presses of tier `layer`.
GRID = 96
# Rate of poses and forces [Hz], and of solutions while the tip moves.
RATE, SOLVED = 200.0, 50.0
# Solutions of one hold.
HELD = 24
# By `fem` the rate of solutions and those of one hold are a sixth.
FEWER = 6
# Width of an indenter without sides, such as a cone [m].
WIDTH = 7e-3
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
class Forces:
    """Forces that a skin gives, without the gauge's errors."""

    time: Array
    """Times of the solutions (n,) [s]."""
    force: Array
    """Forces (n, 3) [N]."""
    top: SurfaceField | None = None
    """Displacement of the top (n frames); None if it was not kept."""

    def at(self, time: Array) -> SurfaceField:
        """Return the top at times (m,) [s], each that of the last solution."""
        assert self.top is not None
        last = np.searchsorted(self.time, time, side="right") - 1
        return replace(self.top, displacement=self.top.displacement[last])


def observed(
    skin: SimulatedSensor,
    presses: PlannedPresses,
    bench: Bench,
    seed: int,
    *,
    grid: int = GRID,
    forces: Forces | None = None,
) -> PressTrack:
    """Return the track that a bench would record of a skin, whose forces may be known."""
    true = solved(skin, presses, bench, grid=grid) if forces is None else forces
    time, tip, force = recorded(presses, bench, seed, true)
    track = track_of(presses.indenter, presses.indenter, time, tip, time, force)
    assert track is not None
    return track


def recorded(
    presses: PlannedPresses, bench: Bench, seed: int, forces: Forces
) -> tuple[Array, Array, Array]:
    """Return times (n,) [s], tips (n, 3) [m] and forces (n, 3) [N] that a bench would record."""
    corners, tips = presses.path()
    time = np.arange(0.0, corners[-1], 1 / RATE)
    late = np.stack(
        [np.interp(time - bench.latency, forces.time, axis) for axis in forces.force.T], axis=1
    )
    turned = late + np.cross(np.array(bench.turn), late)
    tip = np.stack([np.interp(time, corners, axis) for axis in tips.T], axis=1)
    random = np.random.default_rng(seed)
    return time, tip, turned + random.normal(0.0, bench.noise, late.shape)


def solved(
    skin: SimulatedSensor,
    presses: PlannedPresses,
    bench: Bench,
    *,
    grid: int = GRID,
    truth: ContactTier = "layer",
    fem: Fem = FEM,
    device: str = "cpu",
    with_top: bool = False,
) -> Forces:
    """Return the forces of a skin by tier `truth`, of tier `layer` also its top if asked for.

    The tip yields by the forces of tier `layer`, also where forces are those of `fem`.
    """
    corners, tips = presses.path()
    fewer = FEWER if truth == "fem" else 1
    times, places = [0.0], [tips[0]]
    for leg in range(1, len(corners)):
        start, stop = corners[leg - 1], corners[leg]
        held = not np.any(tips[leg] != tips[leg - 1])
        count = HELD // fewer if held else max(2, round((stop - start) * SOLVED / fewer))
        fractions = np.arange(1, count + 1) / count
        for fraction in np.square(fractions) if held else fractions:
            places.append(tips[leg - 1] + fraction * (tips[leg] - tips[leg - 1]))
            times.append(start + fraction * (stop - start))
    time, tip = np.array(times), np.array(places)
    how: dict[str, Any] = {"grid": grid, "truth": truth, "fem": fem, "device": device}
    tops: list[SurfaceField] | None = [] if with_top else None
    force = felt(skin, named(presses.indenter), time, tip, bench, tops=tops, **how)
    if not tops:
        return Forces(time, force)
    shapes = np.concatenate([each.displacement for each in tops])
    return Forces(time, force, replace(tops[0], displacement=shapes))


def felt(
    skin: SimulatedSensor,
    indenter: Indenter,
    time: Array,
    tip: Array,
    bench: Bench,
    *,
    grid: int = GRID,
    truth: ContactTier = "layer",
    fem: Fem = FEM,
    kept: Sequence[int] | None = None,
    tops: list[SurfaceField] | None = None,
    device: str = "cpu",
) -> Array:
    """Return the forces on a skin (n, 3) [N], by tier `truth`, where a bench takes the tip to be.

    Args:
        skin: The skin.
        indenter: The indenter as drawn.
        time: Times (n,) [s]; steps between them are short, for the mount yields by the last force.
        tip: Tip as the bench knows it (n, 3) [m].
        bench: Its errors. The tip yields by forces of tier `layer`, also in tier `fem`.
        grid: Pixels along the body's longer side, of tier `layer`.
        truth: Tier of the forces.
        fem: Mesh and tolerances of tier `fem`.
        kept: Points whose forces are returned, the first among them; None: all.
        tops: Filled with the top's displacement at all points, of tier `layer`.
        device: Device of tier `fem`.
    """
    chosen = np.arange(len(time)) if kept is None else np.asarray(kept)
    indenter, seen = leaning(
        printed(indenter, bench.size), tip + np.array([*bench.place, 0.0]), bench.tilt
    )
    seen[:, 2] -= bench.height
    force = np.zeros_like(seen)
    if truth == "layer" or bench.compliance:
        press = LivePress(skin, indenter, grid=grid, tolerance=2e-3)
        for row in range(len(time)):
            if row:
                seen[row, 2] -= bench.compliance * force[row - 1, 2]
                press.move(seen[row], time[row] - time[row - 1])
            if press.touching:
                force[row] = press.force
            if tops is not None:
                tops.append(press.field)
    if truth == "layer":
        return force[chosen]
    places = tuple(tuple(place) for place in seen[chosen].tolist())
    motion = Motion(places, tuple(time[chosen].tolist()))
    found = simulate(skin.scene(indenter, motion), fem, device=device)
    return np.asarray(found.wrench[:, :3], float)


def printed(indenter: Indenter, size: float) -> Indenter:
    """Return an indenter whose width, of `WIDTH` if it has none, is greater by `size` [m]."""
    width = float(np.diff(indenter.bounds[0])[0])
    scale = 1 + size / (width if np.isfinite(width) else WIDTH)
    if scale == 1:
        return indenter
    return replace(
        indenter,
        parts=tuple(_scaled(part, scale) for part in indenter.parts),
        edge_radius=indenter.edge_radius * scale,
        narrowest=indenter.narrowest * scale,
    )


def _scaled(part: Part, scale: float) -> Part:
    angles = {"half_plane": (0, 1), "band": (0, 1), "circle": (), "path": range(2, 10**6, 3)}
    values = tuple(
        value if place in angles[part.figure] else value * scale
        for place, value in enumerate(part.values)
    )
    return replace(part, values=values, axis=(part.axis[0] * scale, part.axis[1] * scale))


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


def relaxation(ratios: Sequence[float], times: Sequence[float], at: Array) -> Array:
    """Return the relaxation function over that at rest, at times (n,) [s]."""
    found = np.ones_like(at)
    for ratio, time in zip(ratios, times, strict=True):
        found += ratio * np.exp(-at / time)
    return found


def usual(indenter: str, name: str, part: float = 0.4) -> PlannedPresses:
    """Return presses to two depths of a design, sheared and held.

    The first is `part` of the deepest of the design, the second twice as deep.
    """
    step = round(part * sensor(name).depth_max, 5)
    return planned_presses(indenter, (step, 2 * step), 0.8e-3, 1.6)
