"""Fit twins of random skins that are known, and compare.

    python -m benchmarks twin --planted 6
    python -m benchmarks twin --planted 60 --out docs/results/twin-planted.md

Each skin differs from the row that the fit begins with, and is pressed on a bench with errors of
its own, by a finer grid than the fit's, or by tier `fem` (`--truth fem`), while fits are by tier
`layer`. Forces under a torus, which the fit does not get, are held out. The page of `--out` is
written after every skin, so that a stopped run leaves that of the skins so far. In simulation.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

import numpy as np

from benchmarks.sim.twin.planted import GRID, Bench, Truth, observed, random_skin, relaxation
from recorder.command_line.options import add_seed, names, positive, whole
from recorder.pages import render
from sim.cli.twin_plan import CHANGE
from sim.errors import SimulationDiverged
from sim.indenters import NAMES
from sim.sensors import sensor
from sim.sensors.posterior import quantities
from sim.twin import Model, fitted, misfit
from sim.twin.plan import Planner, Presses, presses, sessions

# Indenter whose forces are foretold; no fit gets its presses.
HELD_OUT = "torus"
COLUMNS = ("modulus", "thickness", "relaxation", "friction", "held-out")
# Times at which relaxation is compared [s].
TIMES = np.geomspace(0.05, 2.0, 20)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument(
        "--planted", type=whole(1, 1000), default=6, metavar="N", help="skins (%(default)s)"
    )
    parser.add_argument(
        "--indenters",
        type=names,
        default=("sphere", "prism"),
        metavar="NAME,...",
        help="indenters that the fit gets (sphere,prism)",
    )
    parser.add_argument(
        "--minutes",
        type=positive,
        metavar="MIN",
        help="presses that `tactile twin plan` chooses for this time, in place of --indenters",
    )
    parser.add_argument(
        "--truth",
        choices=get_args(Truth),
        default="layer",
        help="tier of the true forces; by fem, skins are neo-Hookean (%(default)s)",
    )
    parser.add_argument(
        "--grid", type=whole(16, 256), default=64, metavar="N", help="of the fit (%(default)s)"
    )
    parser.add_argument("--sensor", default="gelsight", help="design (%(default)s)")
    parser.add_argument("--out", type=Path, metavar="MD", help="page to write, after every skin")
    add_seed(parser)


@dataclass(frozen=True, slots=True)
class Identified:
    """Errors of the twin of a known skin."""

    number: int
    errors: tuple[float, ...]
    """As fractions, by `COLUMNS`."""
    inside: dict[str, bool]
    """True for a quantity whose 90 % interval has its true value."""
    misfit: float
    seconds: float
    """Time of the fit."""

    def line(self) -> str:
        """Return a row of the printed table."""
        text = f"{self.number:<6}" + "".join(f"{100 * each:>10.1f} %" for each in self.errors)
        return f"{text}{100 * self.misfit:>8.2f} %{self.seconds:>8.0f}"


def run(options: argparse.Namespace) -> int:
    """Fit, print one line for each skin, then medians and coverage; return 1 if none was solved."""
    print(f"{'skin':<6}" + "".join(f"{name:>12}" for name in COLUMNS) + f"{'misfit':>10}{'s':>8}")
    found: list[Identified] = []
    pressed = [usual(name, options.sensor) for name in options.indenters]
    if options.minutes is not None:
        planner = Planner(sensor(options.sensor))
        open_ = planner.candidates([name for name in NAMES if name != HELD_OUT])
        chosen = planner.best(open_, seconds=60 * options.minutes, change=CHANGE)
        pressed = sessions(chosen)
        for each in pressed:
            print(each, flush=True)
    for number in range(options.planted):
        try:
            found.append(one(number, pressed, options))
        except SimulationDiverged as error:
            print(f"{number:<6}  no solution, left out: {error}", flush=True)
            continue
        print(found[-1].line(), flush=True)
        if options.out is not None:
            options.out.write_text(page(found, pressed, options), encoding="utf-8")
    if not found:
        return 1
    print(f"{'median':<6}" + "".join(f"{100 * each:>10.1f} %" for each in medians(found)))
    count = sum(coverage(found).values())
    total = sum(len(each.inside) for each in found)
    print(f"{100 * count / total:.0f} % of {total} true values lie in their 90 % intervals")
    return 0


def medians(found: Sequence[Identified]) -> list[float]:
    """Return the median of the errors of each column."""
    return [float(each) for each in np.median([one.errors for one in found], axis=0)]


def coverage(found: Sequence[Identified]) -> Counter[str]:
    """Return in how many skins the interval of each quantity has its true value."""
    return Counter({name: sum(one.inside[name] for one in found) for name in found[0].inside})


def page(
    found: Sequence[Identified], pressed: Sequence[Presses], options: argparse.Namespace
) -> str:
    """Return the results as a page of Markdown."""
    words = [f"--planted {options.planted}", f"--truth {options.truth}", f"--grid {options.grid}"]
    if options.minutes is None:
        words.append(f"--indenters {','.join(options.indenters)}")
    else:
        words.append(f"--minutes {options.minutes:g}")
    words += [f"--sensor {options.sensor}", f"--seed {options.seed}"]
    return render(
        Path(__file__).with_suffix(".md"),
        command=f"python -m benchmarks twin {' '.join(words)}",
        options=options,
        found=found,
        pressed=pressed,
        columns=COLUMNS,
        held_out=HELD_OUT,
        truth_grid=GRID,
        medians=medians(found),
        coverage=coverage(found),
    )


def usual(indenter: str, name: str) -> Presses:
    """Return presses to two depths of a design, sheared and held."""
    step = round(0.4 * sensor(name).depth_max, 5)
    return presses(indenter, (step, 2 * step), 0.8e-3, 1.6)


def one(number: int, pressed: Sequence[Presses], options: argparse.Namespace) -> Identified:
    """Fit a skin's twin, and compare it with the skin."""
    random = np.random.default_rng([options.seed, number])
    skin, bench = random_skin(random, options.sensor)
    tracks = [
        observed(skin, each, bench, 100 * number + index, truth=options.truth)
        for index, each in enumerate(pressed)
    ]
    began = time.perf_counter()
    fit = fitted(tracks, sensor(options.sensor), grid=options.grid)
    seconds = time.perf_counter() - began
    true = quantities(skin)
    still = observed(
        skin, usual(HELD_OUT, options.sensor), Bench(noise=0.0), number, truth=options.truth
    )
    model = Model(fit.design, [still], grid=options.grid)
    readings = model.readings({name: fit.values[name] for name in true})
    branches = range(1, 1 + sum(name.startswith("ratio") for name in true))
    shapes = [
        relaxation(
            [values[f"ratio_{index}"] for index in branches],
            [values[f"time_{index}"] for index in branches],
            TIMES,
        )
        for values in (fit.values, true)
    ]
    row = [abs(fit.values[name] / true[name] - 1) for name in ("modulus", "thickness")]
    row.append(float(np.sqrt(np.mean(np.square(shapes[0] / shapes[1] - 1)))))
    row.append(abs(fit.values["friction"] / true["friction"] - 1))
    row.append(misfit([still], readings))
    inside = {}
    for name, value in true.items():
        low, high = fit.interval(name)
        inside[name] = low <= value <= high
    return Identified(number, tuple(row), inside, fit.misfit, seconds)
