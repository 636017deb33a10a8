"""`python -m benchmarks slip`: slips of simulated objects that are noticed, and false alarms.

Faces are pressed by superposed presses (`sim.ladder`), driven beyond friction or handled without
slip. True slip is the way that the part of the face slides which sticks longest.
"""

import argparse
import math
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.report import Benchmark, Page, Part, Run, table
from learning.force.slip import SlipWatch
from recorder.command_line.options import whole
from rig.bench.worlds import WorldSpec
from rig.mock.world.sensors import pad_of
from sim.indenters import NAMES
from sim.ladder import Ladder, LadderPress
from sim.sensors import TaxelSignal, sensor
from sim.stream import LiveMarkers

SENSORS = ("gelsight", "digit", "uskin")
# Rate of readings, and steps of the press between them; noise of marker centres as measured in
# pictures of the mock's camera, which has one grey level [px]; that of taxels is the row's.
RATE_HZ, STEPS, NOISE_PX = 60, 8, 0.01
# Rates of the frames of which one or both are watched.
RATES = (60, 30)
# Slip [m] that is to be noticed, the time for it [s], and the time before it that is no alarm.
SLIP, WITHIN, EARLY = 50e-6, 0.05, 0.1
# Part of the friction up to which an object is loaded without slip.
HELD = 0.8


@cache
def view(name: str) -> tuple[Any, Any, float]:
    """Return points of a skin, a function from their displacement to a field, and its noise."""
    row = sensor(name)
    if isinstance(row.signal, TaxelSignal):
        points, counts = pad_of(WorldSpec(sensor=name))
        rest = counts(np.zeros((len(points), 3)))
        return points, lambda moved: counts(moved) - rest, row.signal.noise
    live = LiveMarkers(row)
    still = live.outlines(np.zeros((len(live.points), 3))).mean(axis=1)
    return live.points, lambda moved: live.outlines(moved).mean(axis=1) - still, NOISE_PX


class Grip:
    """A face on a skin at a random place, its readings, and its true slip at each."""

    def __init__(self, name: str, seed: int) -> None:
        self.name = name
        self.random = rng = np.random.default_rng([seed, SENSORS.index(name)])
        most = 0.0
        while most < 1.0:
            ladder = cache(Ladder.of)(str(rng.choice(NAMES)), sensor(name))
            most = min(10.0, ladder.normal(sensor(name).depth_max))
        self.friction, self.depth = rng.uniform(0.3, 0.9), ladder.deepest(rng.uniform(1.0, most))
        self._press = LadderPress(ladder, self.friction, sensor(name).effects.viscosity)
        self.start = np.array([*rng.uniform(-1.5e-3, 1.5e-3, 2), 0.0])
        self.reach = self.friction * ladder.travel(self.depth)
        self._view, self._steps = view(name), int(rng.integers(STEPS))
        self.slip, self.readings = 0.0, list[tuple[float, float, Any]]()
        self._press.move(self.start, 0.0)
        self.hold(0.1)
        self.to(self.at(0.0, 0.0), rng.uniform(5e-3, 20e-3))
        self.hold(0.2)

    def speed(self) -> float:
        """Return a random speed [m/s]."""
        return float(np.exp(self.random.uniform(math.log(0.5e-3), math.log(20e-3))))

    def at(self, load: float, angle: float, depth: float = 1.0) -> Any:
        """Return the tip at a part of the friction, a direction [rad] and a part of the depth."""
        way = load * self.reach * np.array([math.cos(angle), math.sin(angle)])
        return self.start + np.array([*way, -depth * self.depth])

    @property
    def tip(self) -> Any:
        """Place of the tip (3,) [m]."""
        return self._press.tip

    def hold(self, seconds: float) -> None:
        """Stand still."""
        for _ in range(round(seconds * RATE_HZ * STEPS)):
            self._move(self.tip)

    def to(self, tip: Any, speed: float) -> None:
        """Go straight to a tip (3,) [m]."""
        start, step = self._press.tip, speed / (RATE_HZ * STEPS)
        for part in np.linspace(0, 1, max(2, math.ceil(np.linalg.norm(tip - start) / step)))[1:]:
            self._move(start + part * (tip - start))

    def _move(self, tip: Any) -> None:
        press = self._press
        slid = press.slide(tip, 1 / (RATE_HZ * STEPS))
        if press.wrench[2]:
            self.slip += slid
        self._steps += 1
        if self._steps % STEPS == 0:
            points, field, noise = self._view
            now = field(press.markers(points))
            now = now + noise * self.random.normal(size=now.shape)
            self.readings.append((self._steps / (RATE_HZ * STEPS), self.slip, now))


def alarms(grip: Grip, every: int) -> list[float]:
    """Return the times [s] at which slip begins to be seen, by one of `every` readings."""
    watch, seen, before = SlipWatch(view(grip.name)[2]), list[float](), False
    for t, _, field in grip.readings[::every]:
        slip = watch.update(round(t * 1e9), field)
        now = slip is not None and slip.gross
        seen += [t] if now and not before else []
        before = now
    return seen


def slid(name: str, seed: int) -> dict[int, float]:
    """Return by rate the time from 50 um of slip to its alarm [s]; inf: missed or far too early."""
    grip = Grip(name, seed)
    angle, speed = grip.random.uniform(0, math.tau), grip.speed()
    grip.to(grip.at(0.7, angle), max(speed, 5e-3))
    grip.hold(0.1)
    while grip.slip < SLIP + 0.15 * speed:
        grip.to(grip.tip + 0.02 * speed * np.array([math.cos(angle), math.sin(angle), 0]), speed)
    t, slip = np.array([(t, slip) for t, slip, _ in grip.readings]).T
    began, reached = t[slip > 1e-9][0], float(np.interp(SLIP, slip, t))
    first = {rate: next(iter(alarms(grip, RATE_HZ // rate)), math.inf) for rate in RATES}
    return {rate: at - reached if at > began - EARLY else math.inf for rate, at in first.items()}


def held(name: str, seed: int) -> tuple[float, dict[int, int]]:
    """Return the time [s] for which an object is held, squeezed, loaded and turned, and alarms."""
    grip = Grip(name, seed)
    rng, load, angle = grip.random, 0.0, 0.0
    for _ in range(6):
        if (kind := rng.integers(4)) == 0:
            grip.hold(0.5)
        elif kind == 1:
            for depth in (rng.uniform(1.0, 1.1), 1.0):
                grip.to(grip.at(min(load, 0.7), angle, depth), grip.speed() / 3)
        elif kind == 2:
            load, angle = rng.uniform(0, HELD), angle if load else rng.uniform(0, math.tau)
            grip.to(grip.at(load, angle, rng.uniform(1.0, 1.05)), grip.speed())
        else:
            speed, load = grip.speed(), min(load, 0.55)
            for turn in np.linspace(angle, angle := angle + rng.uniform(-1.5, 1.5), 12):
                grip.to(grip.at(load, turn), speed)
    assert grip.slip < 1e-6, (name, seed, grip.slip)
    return grip.readings[-1][0], {rate: len(alarms(grip, RATE_HZ // rate)) for rate in RATES}


def _measure(run: Run) -> Any:
    draws = 4 if run.quick else run.options.draws
    run.seeds, rows = range(draws), {}
    for number, name in enumerate(SENSORS):
        late = [run.once(f"{name} {k}", partial(slid, name, k)) for k in run.seeds]
        run.progress((number + 0.4) / len(SENSORS))
        still = [run.once(f"{name} {k} held", partial(held, name, k)) for k in run.seeds]
        run.progress((number + 1) / len(SENSORS))
        rows[name] = {
            str(rate): {
                "noticed": sum(_of(one, rate) <= WITHIN for one in late) / draws,
                "median": float(np.median([_of(one, rate) for one in late])),
                "alarms": sum(_of(one, rate) for _, one in still),
                "seconds": sum(seconds for seconds, _ in still),
            }
            for rate in RATES
        }
    return rows


def _of(by_rate: dict[Any, Any], rate: int) -> Any:
    return by_rate.get(rate, by_rate.get(str(rate)))


def _section(rows: Any, page: Page) -> str:
    head = ["sensor", "frames a second", "noticed [%]", "median [ms]", "alarms", "held [s]"]
    lines = []
    for name, rates in rows.items():
        for rate, one in rates.items():
            noticed, median = f"{100 * one['noticed']:.1f}", f"{1e3 * one['median']:.0f}"
            lines.append([name, rate, noticed, median, one["alarms"], f"{one['seconds']:.0f}"])
    text = (
        "Noticed: within 50 ms after 50 um of true slip; alarms: in objects held, squeezed, turned"
    )
    return f"## Slips\n\n{text}, loaded to {HELD:g} of friction.\n\n{table(head, lines)}"


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--draws", type=whole(1, 10000), default=200, help="of each (%(default)s)")


BENCHMARK = Benchmark(
    "slip",
    "Slip of held objects, in simulation",
    "How many slips are noticed in time, and how often is there an alarm without slip? Shapes, "
    "normal forces of 1 to 10 N, friction of 0.3 to 0.9 and speeds of 0.5 to 20 mm/s are random.",
    [Part("slips", _measure, _section)],
    options=_options,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
