"""Frames per second of presses in small steps, one or many at once, and their errors."""

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks.accuracy.chart import Panel, Series, save_chart
from benchmarks.accuracy.competitors import elements_of
from benchmarks.accuracy.speed import AUGMENTATIONS, PATH_TOLERANCE, TOLERANCE
from benchmarks.accuracy.wording import Row, chosen, devices_of, kind_of, percent, rounded
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, GREEN, ORANGE, RED, SKY
from recorder.processes import Workers, several
from sim.device import ready_device
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.indenters import sphere
from sim.layer import Layer
from sim.result import Outcome, force_scale
from sim.scene import Scene, press
from sim.tiers import simulate_many

MM = 1e-3
FRAME, FRAMES = 0.05 * MM, 20
DEPTHS = tuple(FRAME * frame for frame in range(1, FRAMES + 1))
# Numbers of simultaneous presses.
COUNTS = (1, 64, 512)
# Number of presses whose errors are measured.
COMPARED = 4
# First frame whose error is measured, 0 being the touch: 0.1 mm.
FROM = 2
# Presses that fill a GPU: from there on their time grows with their number.
FILLS = 64
# Rows that are expected to take longer are left out [s].
ROW_SECONDS = 15.0
# Seed of the spheres and their places.
SEED = 0
# Frames per second that others state for tactile simulators with soft contact, as in their papers:
# other scenes, other hardware, and no error of the force.
PUBLISHED = (
    ("TaCauchy (arXiv 2606.20426)", 1, 33.4),
    ("TaCauchy (arXiv 2606.20426)", 60, 555.0),
    ("ETac, a learned model", 4096, 869.0),
)
COLOURS = (GREEN, SKY, ORANGE, BLUE, RED)
# Ways: `layer`, coarse meshes of `fem` with matching tolerances, and the default.
DEFAULT = "fem, default"
COARSE = Fem(tolerance=TOLERANCE, path_tolerance=PATH_TOLERANCE, augmentations=AUGMENTATIONS)
WAYS: dict[str, Layer | Fem] = {
    **{f"layer, {grid} pixels": Layer(grid=grid) for grid in (48, 128)},
    **{f"fem, {size:g} mm": replace(COARSE, spacing=size * MM) for size in (1.0, 0.8)},
    DEFAULT: Fem(),
}


def scenes(count: int, depths: Sequence[float] = DEPTHS) -> list[Scene]:
    """Return the first `count` presses, which are the same for every count."""
    random = np.random.default_rng(SEED)
    drawn = random.uniform([3 * MM, -4 * MM, -4 * MM], [5 * MM, 4 * MM, 4 * MM], (count, 3))
    return [Scene(sphere(r), press(depths, at=(x, y))) for r, x, y in drawn]


def errors(outcomes: Sequence[Outcome], truths: Sequence[Outcome]) -> dict[str, float | None]:
    """Return mean and largest error of the presses that have a reference, as fractions."""
    fractions = [
        (np.linalg.norm(one.force - truth.force, axis=1) / force_scale(truth.force))[FROM:]
        for one, truth in zip(outcomes, truths, strict=False)
        if not isinstance(one, SimulationDiverged) and not isinstance(truth, SimulationDiverged)
    ]
    if not fractions:
        return {"mean": None, "worst": None}
    mean, worst = float(np.mean(fractions)), float(np.max(fractions))
    return {"mean": rounded(mean), "worst": rounded(worst)}


def measure(run: Run) -> list[Row]:
    """Return a row for every way, device and number of presses, except those that take long."""
    names = list(WAYS)
    chosen = names[:3:2] if run.quick else names
    fine = Fem(fineness=0.5 if run.quick else 1.5, elements_max=400_000)
    devices = devices_of(run.device)
    rows: list[Row] = []
    run.seeds, run.spread = [SEED], "single run of each"
    ready_device(run.device)
    truths = simulate_many(scenes(1 if run.quick else COMPARED), fine, device=run.device)
    for number, device in enumerate(devices):
        ready_device(device)
        with several(run.options.processes) as workers:
            for step, way in enumerate(chosen):
                rows += _counted(run, way, device, workers, truths)
                run.progress((number + (step + 1) / len(chosen)) / len(devices))
    return rows


def _counted(
    run: Run, way: str, device: str, workers: Workers | None, truths: Sequence[Outcome]
) -> list[Row]:
    """Return the rows of one way: in one process, and several presses also by `workers`.

    On a CPU one process solves only one press, as several would follow one another. On a GPU
    `layer` solves all in one launch.
    """
    rows: list[Row] = []
    last: Row | None = None
    # Many of the default in one process on a GPU would take minutes.
    counts = COUNTS[:1] if run.quick or (way == DEFAULT and device != "cpu") else COUNTS
    ready = set[Workers | None]()
    for count in counts:
        pools: list[Workers | None] = [None] if device != "cpu" or count == 1 else []
        if workers is not None and count > 1 and (device == "cpu" or not way.startswith("layer")):
            pools.append(workers)
        for pool in pools:
            if forecast(last, count, 1 if pool is None else pool.processes) > ROW_SECONDS:
                continue
            if pool not in ready:
                shallow = scenes(1 if pool is None else pool.processes, [FRAME])
                _solved(shallow, way, device, pool)
                ready.add(pool)
            name = f"{way}, {device}, {count} at once" + (" by processes" if pool else "")
            rows.append(run.once(name, partial(measured, way, count, device, pool, truths)))
            last = last if pool else rows[-1]
    return rows


def _solved(some: Sequence[Scene], way: str, device: str, workers: Workers | None) -> list[Outcome]:
    """Solve presses; on a GPU all have one mesh topology."""
    tier = WAYS[way]
    if isinstance(tier, Fem):
        tier = replace(tier, one_topology=device != "cpu")
    return simulate_many(some, tier, device=device, processes=workers or 1)


def forecast(last: Row | None, count: int, processes: int) -> float:
    """Return the expected time of `count` presses [s], by a row with fewer; 0 if it is unknown."""
    if last is None:
        return 0.0
    if last["device"] == "cpu":
        return float(last["seconds"] * math.ceil(count / processes) / last["at_once"])
    if last["at_once"] < FILLS:
        return 0.0
    return float(last["seconds"] * count / last["at_once"])


def measured(
    way: str, count: int, device: str, workers: Workers | None, truths: Sequence[Outcome]
) -> Row:
    """Solve `count` presses, and return their row."""
    began = time.perf_counter()
    outcomes = _solved(scenes(count), way, device, workers)
    wall = time.perf_counter() - began
    good = [one for one in outcomes if not isinstance(one, SimulationDiverged)]
    return errors(outcomes, truths) | {
        "way": way,
        "device": device,
        "processes": 1 if workers is None else workers.processes,
        "at_once": count,
        "elements": elements_of(good[0]) if good else 0,
        "seconds": rounded(wall),
        "frames_per_second": rounded(FRAMES * len(good) / wall),
        "failed": len(outcomes) - len(good),
    }


# The page


def section(rows: Sequence[Row], page: Page) -> str:
    """Return the picture and the table."""
    series = [
        Series(
            f"{name}, {kind}",
            colour,
            style,
            [
                (100 * row["mean"], row["frames_per_second"])
                for row in chosen(rows, kind, way=name)
                if row["mean"]
            ],
        )
        for name, colour in zip(WAYS, COLOURS, strict=True)
        for kind, style in (("CPU", "o"), ("GPU", "D"))
    ]
    save_chart(
        page.picture("frames"),
        "Frames per second and the error of their forces",
        [Panel("", series)],
        "mean error of the force [%]",
        "frames per second",
    )
    lines = []
    for name, device in dict.fromkeys((row["way"], row["device"]) for row in rows):
        some = chosen(rows, way=name, device=device)
        alone = min(some, key=lambda row: int(row["at_once"]))
        fastest = max(some, key=lambda row: float(row["frames_per_second"]))
        lines.append(
            [
                name,
                kind_of(device),
                f"{fastest['elements']:,}",
                *(f"{row['frames_per_second']:,.0f}" for row in (alone, fastest)),
                fastest["at_once"],
                fastest["processes"],
                sum(row["failed"] for row in some),
                percent(fastest["mean"]),
                percent(fastest["worst"]),
            ]
        )
    head = ["way", "on", "elements", "frames/s of one press", "most frames/s", "presses at once"]
    cited = "; ".join(f"{name} {rate:g} frames/s of {count}" for name, count, rate in PUBLISHED)
    return f"""## Frames per second

{page.link("frames", "Frames per second against the error of the force")}

{table([*head, "processes", "without a solution", "mean error", "worst"], lines)}

Spheres of 3 to 5 mm are pressed 1 mm deep in {FRAMES} frames of {FRAME / MM:g} mm, one or many at
once, at places of their own; errors from 0.1 mm on are relative to elements half as long as the
default's. *Every solver* has another press, whose mesh differs, and the error of its worst frame.
Others state, with other scenes and hardware and without an error: {cited} at once."""
