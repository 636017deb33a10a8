"""Fit twins of random skins that are known, and compare.

    python -m benchmarks twin --skins 6
    python -m benchmarks twin --skins 200 --processes 16 --out docs/results/twin-planted.md

Each skin differs from the row that the fit begins with, and is pressed on a bench with errors of
its own, by a finer grid than the fit's, or by tier `fem` (`--truth fem`). Fits are by tier `layer`,
as it is or corrected by `fem` (`--fit fem`). Forces under a torus, which the fit does not get, are
held out. The page of `--out` is written after every skin, and the same command goes on where it
stopped: its rows are beside the page. Forces by `fem` may be stored before (`--make`, on a GPU, and
it goes on likewise) and read (`--truths`). In simulation.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar, get_args

import numpy as np

from benchmarks.twin.planted import (
    GRID,
    Bench,
    Forces,
    observed,
    random_skin,
    relaxation,
    solved,
)
from recorder.command_line.options import add_device, add_seed, names, positive, whole
from recorder.pages import render
from sim.cli.twin_plan import CHANGE
from sim.errors import SceneError, SimulationDiverged
from sim.indenters import NAMES
from sim.result import ContactTier
from sim.sensors import sensor
from sim.sensors.quantities import quantities
from sim.twin import TrackModel, fitted, misfit
from sim.twin.fit import Z
from sim.twin.plan import PlannedPresses, Planner, planned_presses, sessions

# Indenter whose forces are foretold; no fit gets its presses.
HELD_OUT = "torus"
COLUMNS = ("modulus", "thickness", "relaxation", "friction", "held-out")
# Most skins of which a page shows each.
ROWS_SHOWN = 20
# Times at which relaxation is compared [s].
TIMES = np.geomspace(0.05, 2.0, 20)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the benchmark."""
    parser.add_argument(
        "--skins", type=whole(1, 1000), default=6, metavar="N", help="(%(default)s)"
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
        choices=get_args(ContactTier),
        default="layer",
        help="tier of the true forces; by fem, skins are neo-Hookean (%(default)s)",
    )
    parser.add_argument(
        "--fit",
        choices=("layer", "fem"),
        default="layer",
        help="tier of the fits; fem corrects forces of layer (%(default)s)",
    )
    parser.add_argument(
        "--grid", type=whole(16, 256), default=64, metavar="N", help="of the fit (%(default)s)"
    )
    parser.add_argument("--sensor", default="gelsight", help="design (%(default)s)")
    parser.add_argument(
        "--depth",
        type=positive,
        default=0.4,
        metavar="PART",
        help="first of two depths, over the deepest of the design (%(default)s)",
    )
    parser.add_argument(
        "--processes", type=whole(1, 256), default=1, metavar="N", help="(%(default)s)"
    )
    parser.add_argument(
        "--make", type=Path, metavar="NPZ", help="store the true forces of all skins; fit nothing"
    )
    parser.add_argument("--truths", type=Path, metavar="NPZ", help="read them, in place of solving")
    parser.add_argument("--out", type=Path, metavar="MD", help="page to write, after every skin")
    add_device(parser, "device of true forces by fem")
    add_seed(parser)


@dataclass(frozen=True, slots=True)
class Identified:
    """Errors of the twin of a known skin."""

    number: int
    errors: tuple[float, ...]
    """As fractions, by `COLUMNS`."""
    off: dict[str, float]
    """Distance of each quantity from its true value, in its posterior's spread."""
    misfit: float
    seconds: float
    """Time of the fit."""

    def line(self) -> str:
        """Return a row of the printed table."""
        text = f"{self.number:<6}" + "".join(f"{100 * each:>10.1f} %" for each in self.errors)
        return f"{text}{100 * self.misfit:>8.2f} %{self.seconds:>8.0f}"


def run(options: argparse.Namespace) -> int:
    """Fit, print one line for each skin, then medians and coverage; return 1 if none was solved."""
    pressed = pressed_by(options)
    if options.make is not None:
        return make(pressed, options)
    print(f"{'skin':<6}" + "".join(f"{name:>12}" for name in COLUMNS) + f"{'misfit':>10}{'s':>8}")
    path = None if options.out is None else options.out.with_suffix(".jsonl")
    found = [] if path is None else kept(path, options)
    for each in found:
        print(each.line(), flush=True)
    done = {each.number for each in found}
    wanted = [number for number in range(options.skins) if number not in done]
    for number, row in each_of(functools.partial(one, pressed, options), wanted, options):
        if isinstance(row, str):
            print(f"{number:<6}  no solution, left out: {row}", flush=True)
            continue
        print(row.line(), flush=True)
        found = sorted([*found, row], key=lambda each: each.number)
        if options.out is not None and path is not None:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(row)) + "\n")
            options.out.write_text(page(found, pressed, options), encoding="utf-8")
    if not found:
        return 1
    print(f"{'median':<6}" + "".join(f"{100 * each:>10.1f} %" for each in medians(found)))
    count = sum(coverage(found).values())
    total = sum(len(each.off) for each in found)
    print(f"{100 * count / total:.0f} % of {total} true values lie in their 90 % intervals")
    return 0


def pressed_by(options: argparse.Namespace) -> list[PlannedPresses]:
    """Return the presses that fits get."""
    if options.minutes is None:
        return [usual(name, options.sensor, options.depth) for name in options.indenters]
    planner = Planner(sensor(options.sensor))
    open_ = planner.candidates([name for name in NAMES if name != HELD_OUT])
    chosen = planner.best(open_, seconds=60 * options.minutes, change=CHANGE)
    for each in sessions(chosen):
        print(each, flush=True)
    return sessions(chosen)


Key = TypeVar("Key")


def each_of(
    task: Callable[[Key], Any], keys: Sequence[Key], options: argparse.Namespace
) -> Iterator[tuple[Key, Any]]:
    """Yield each key with the task's result, as they come."""
    if options.processes == 1:
        yield from ((key, task(key)) for key in keys)
        return
    context = get_context("spawn")
    with ProcessPoolExecutor(options.processes, mp_context=context) as pool:
        futures = {pool.submit(task, key): key for key in keys}
        for future in as_completed(futures):
            yield futures[future], future.result()


def settings(options: argparse.Namespace) -> dict[str, Any]:
    """Return what the rows of a page must have in common."""
    names = ("truth", "fit", "grid", "indenters", "minutes", "depth", "sensor", "seed")
    return {name: getattr(options, name) for name in names}


def kept(path: Path, options: argparse.Namespace) -> list[Identified]:
    """Return the rows of an earlier run, as `stored`."""
    found = stored(path, settings(options))
    return [Identified(**{**row, "errors": tuple(row["errors"])}) for row in found]


def stored(path: Path, settings: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the rows of a file of an earlier run; begin the file if there is none.

    Raises:
        SceneError: They are of other settings.
    """
    ours = json.loads(json.dumps(settings))
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(ours) + "\n", encoding="utf-8")
        return []
    first, *rows = path.read_text(encoding="utf-8").splitlines()
    if json.loads(first) != ours:
        raise SceneError(f"{path}: rows of {first}; allowed: those of {json.dumps(ours)}")
    return [json.loads(row) for row in rows]


def medians(found: Sequence[Identified]) -> list[float]:
    """Return the median of the errors of each column."""
    return [float(each) for each in np.median([one.errors for one in found], axis=0)]


def coverage(found: Sequence[Identified]) -> Counter[str]:
    """Return in how many skins the interval of each quantity has its true value."""
    return Counter({name: sum(abs(one.off[name]) <= Z for one in found) for name in found[0].off})


def needed(found: Sequence[Identified]) -> dict[str, float]:
    """Return by which factor the spread of each quantity must be wider to cover 90 %."""
    return {
        name: float(np.quantile([abs(one.off[name]) for one in found], 0.9)) / Z
        for name in found[0].off
    }


def page(
    found: Sequence[Identified], pressed: Sequence[PlannedPresses], options: argparse.Namespace
) -> str:
    """Return the results as a page of Markdown."""
    words = [f"--skins {options.skins}", f"--truth {options.truth}", f"--fit {options.fit}"]
    words.append(f"--grid {options.grid}")
    if options.minutes is None:
        words.append(f"--indenters {','.join(options.indenters)} --depth {options.depth:g}")
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
        most=[float(each) for each in np.quantile([one.errors for one in found], 0.9, axis=0)],
        rows_shown=ROWS_SHOWN,
        coverage=coverage(found),
        needed=needed(found),
    )


def usual(indenter: str, name: str, part: float = 0.4) -> PlannedPresses:
    """Return presses to two depths of a design, sheared and held."""
    step = round(part * sensor(name).depth_max, 5)
    return planned_presses(indenter, (step, 2 * step), 0.8e-3, 1.6)


def asked(
    pressed: Sequence[PlannedPresses], bench: Bench, options: argparse.Namespace
) -> list[tuple[PlannedPresses, Bench]]:
    """Return the presses of a skin and the errors that each has, those held out last."""
    held_out = usual(HELD_OUT, options.sensor, options.depth)
    return [*((each, bench) for each in pressed), (held_out, Bench(noise=0.0))]


def make(pressed: Sequence[PlannedPresses], options: argparse.Namespace) -> int:
    """Store the true forces of all skins that are not stored yet; return the exit code."""
    path: Path = options.make
    stored = dict(np.load(path)) if path.exists() else {}
    wanted = [number for number in range(options.skins) if f"{number}-0" not in stored]
    for number, found in each_of(functools.partial(forces, pressed, options), wanted, options):
        if isinstance(found, str):
            print(f"{number:<6}  no solution: {found}", flush=True)
            continue
        for index, each in enumerate(found):
            stored[f"{number}-{index}"] = np.column_stack([each.time, each.force])
        part = path.with_suffix(".part.npz")
        np.savez_compressed(part, **stored)
        part.replace(path)
        print(f"{number:<6}  stored", flush=True)
    return 0


def forces(
    pressed: Sequence[PlannedPresses], options: argparse.Namespace, number: int
) -> list[Forces] | str:
    """Return the true forces of a skin, or why there are none."""
    skin, bench = random_skin(np.random.default_rng([options.seed, number]), options.sensor)
    try:
        return [
            solved(skin, each, errors, truth=options.truth, device=options.device)
            for each, errors in asked(pressed, bench, options)
        ]
    except SimulationDiverged as error:
        return str(error)


def read_forces(path: Path, count: int, number: int) -> list[Forces] | str:
    """Return the `count` stored forces of a skin, or why there are none."""
    with np.load(path) as file:
        if f"{number}-0" not in file:
            return f"not in {path}"
        rows = [file[f"{number}-{index}"] for index in range(count)]
    return [Forces(row[:, 0], row[:, 1:]) for row in rows]


def one(
    pressed: Sequence[PlannedPresses], options: argparse.Namespace, number: int
) -> Identified | str:
    """Fit a skin's twin, and compare it with the skin; a text if it has no solution."""
    try:
        return identified(pressed, options, number)
    except SimulationDiverged as error:
        return str(error)


def identified(
    pressed: Sequence[PlannedPresses], options: argparse.Namespace, number: int
) -> Identified | str:
    """Fit a skin's twin, and compare it with the skin."""
    skin, bench = random_skin(np.random.default_rng([options.seed, number]), options.sensor)
    wanted = asked(pressed, bench, options)
    if options.truths is None:
        known = forces(pressed, options, number)
    else:
        known = read_forces(options.truths, len(wanted), number)
    if isinstance(known, str):
        return known
    *tracks, still = (
        observed(skin, each, errors, 100 * number + index, forces=true)
        for index, ((each, errors), true) in enumerate(zip(wanted, known, strict=True))
    )
    began = time.perf_counter()
    fit = fitted(tracks, sensor(options.sensor), grid=options.grid, tier=options.fit)
    seconds = time.perf_counter() - began
    true = quantities(skin)
    model = TrackModel(fit.design, [still], grid=options.grid)
    values = {name: fit.values[name] for name in true}
    if fit.tier == "fem":
        model.correct(values)
    readings = model.readings(values)
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
    off = {name: fit.distance(name, value) for name, value in true.items()}
    return Identified(number, tuple(row), off, fit.misfit, seconds)
