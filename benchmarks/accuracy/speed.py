"""Time of the paper's 162 presses with coarser and finer meshes, and the errors of their forces.

Errors are relative to the forces of a fine mesh, which are stored.
"""

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.accuracy.chart import Panel, Series, save_chart
from benchmarks.accuracy.spent import WARM, spent_by
from benchmarks.accuracy.wording import Row, chosen, devices_of, kind_of, percent, rounded, seconds
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, RED
from recorder.processes import Workers, several
from recorder.store import replace_file
from sim.device import ready_device
from sim.errors import SimulationDiverged
from sim.fem import FOR_EDGES, Fem
from sim.indenters import NAMES, named
from sim.paper_presses import DEPTHS_MM, PLACES_MM
from sim.result import Outcome, Result
from sim.scene import Effects, Friction, Scene, press
from sim.tiers import gathered, simulate_many, submitted
from sim.tolerance import left_of_difference

MM = 1e-3
# Coulomb coefficient of the presses.
FRICTION = 0.8
# All places [mm], and those whose forces are compared: middle, corner and side, which by
# symmetry represent all nine.
PLACES = tuple(product(PLACES_MM, PLACES_MM))
REFERENCE_AT = ((0.0, 0.0), (4.0, 4.0), (0.0, 4.0))
# Forces by the mesh of the reference, which takes minutes on a GPU.
REFERENCE = Path(__file__).with_name("paper_forces.csv")
COLUMNS = ("indenter", "x_mm", "y_mm", "depth_mm", "fx", "fy", "fz")
# Minimum depth for an error: at smaller depths, forces are a few hundredths of the largest.
SHALLOW_MM = 0.6
# Element heights [mm], coarse to fine; the finest takes long on a CPU.
SPACINGS = {"CPU": (4 / 3, 1.0, 0.8), "GPU": (1.5, 4 / 3, 1.0, 0.8, 2 / 3)}
# The same of a quick run, and its indenters, which are smooth, and depths [mm].
QUICK_SPACINGS, QUICK = (4 / 3, 1.0), (("sphere", "wave"), (0.3, 0.6))
# Two meshes that are solved at once, the finer first, and their tolerance, by kind of device.
AT_ONCE = {"CPU": (0.8, 4 / 3), "GPU": (1.0, 1.5)}
AT_ONCE_TOLERANCE = 0.03
# Range of the ratio of the element sizes of two meshes: closer ones amplify random errors.
APART, APART_MOST = 1.3, 5 / 3 + 1e-3
# Settings of the timed presses: residual over force at the depths that are stored and between
# them, and number of multiplier updates. Tighter settings change no mesh's error by 0.1 %.
TOLERANCE, PATH_TOLERANCE, AUGMENTATIONS = 1.5e-2, 0.1, 1
# The same of the reference, and its element height [mm]. With tighter ones the skin creases under
# sharp edges, where there are many solutions, and the solver fails.
REFERENCE_TOLERANCE, REFERENCE_AUGMENTATIONS, REFERENCE_SPACING = 3e-4, 5, 0.4


# Force of the indenter on the body (3,) [N], by indenter, x, y, depth [mm].
Forces = dict[tuple[str, float, float, float], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class TimedPress:
    """One indenter at one place, to all depths, in millimetres as in the file."""

    indenter: str
    x: float
    y: float
    depths: tuple[float, ...] = DEPTHS_MM

    def scene(self) -> Scene:
        """Return the scene of the press."""
        return Scene(
            named(self.indenter),
            press([depth * 1e-3 for depth in self.depths], at=(self.x * 1e-3, self.y * 1e-3)),
            effects=Effects(friction=Friction(FRICTION)),
        )


def presses_at(
    places: Iterable[tuple[float, float]],
    names: Sequence[str] = NAMES,
    depths: tuple[float, ...] = DEPTHS_MM,
) -> list[TimedPress]:
    """Return the presses of indenters at places [mm]."""
    return [TimedPress(name, x, y, depths) for name in names for x, y in places]


def forces_of(presses: Sequence[TimedPress], outcomes: Sequence[Outcome]) -> Forces:
    """Return the forces of the presses that have a solution."""
    return {
        (one.indenter, one.x, one.y, depth): force
        for one, outcome in zip(presses, outcomes, strict=True)
        if isinstance(outcome, Result)
        # In the first frame the indenter only touches the surface.
        for depth, force in zip(one.depths, outcome.force[1:], strict=True)
    }


def extrapolated(fine: Forces, coarse: Forces, ratio: float) -> Forces:
    """Return the forces that both meshes have, extrapolated by the `ratio` of their spacings."""
    more = left_of_difference(ratio)
    return {
        key: force + more * (force - coarse[key]) for key, force in fine.items() if key in coarse
    }


def errors(forces: Forces, reference: Forces) -> Row:
    """Return |F - Fref| / |Fref| over common presses, at depths of at least `SHALLOW_MM`.

    `compared` is the number of presses, `most` the 95th percentile.
    """
    both = [key for key in reference if key in forces and key[3] >= SHALLOW_MM]
    if not both:
        return {"compared": 0, "mean": None, "most": None, "worst": None, "worst_at": ""}
    true = np.array([reference[key] for key in both])
    difference = np.array([forces[key] for key in both]) - true
    fraction = np.linalg.norm(difference, axis=1) / np.linalg.norm(true, axis=1)
    name, x, y, depth = both[int(fraction.argmax())]
    return {
        "compared": len({key[:3] for key in both}),
        "mean": float(fraction.mean()),
        "most": float(np.percentile(fraction, 95)),
        "worst": float(fraction.max()),
        "worst_at": f"{name} at ({x:g}, {y:g}) mm, {depth:g} mm deep",
    }


def write_forces(forces: Forces, path: Path = REFERENCE) -> None:
    """Write forces in [N] to seven digits."""
    lines = [",".join(COLUMNS)]
    for (name, *place), force in forces.items():
        numbers = [*(f"{one:g}" for one in place), *(f"{one:.7g}" for one in force)]
        lines.append(",".join([name, *numbers]))
    replace_file(path, ("\n".join(lines) + "\n").encode())


def read_forces(path: Path = REFERENCE) -> Forces:
    """Read the forces written by `write_forces`."""
    forces: Forces = {}
    with path.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            name, *numbers = (row[column] for column in COLUMNS)
            x, y, depth, *force = map(float, numbers)
            forces[name, x, y, depth] = np.array(force)
    return forces


def numerics(spacing: float, device: str, tolerance: float = TOLERANCE) -> Fem:
    """Return the settings of a mesh with elements of `spacing` [mm] over the depth."""
    return Fem(
        spacing=spacing * MM,
        grading=FOR_EDGES,
        tolerance=tolerance,
        path_tolerance=PATH_TOLERANCE,
        augmentations=AUGMENTATIONS,
        one_topology=device != "cpu",
    )


def measure(run: Run) -> list[Row]:
    """Return the rows of every mesh, of pairs of meshes, and of pairs that are solved at once."""
    presses = presses_at(REFERENCE_AT[:2], *QUICK) if run.quick else presses_at(PLACES)
    if run.options.references:
        write_reference(run.device)
    reference = read_forces()
    rows: list[Row] = []
    devices = devices_of(run.device)
    for number, device in enumerate(devices):
        spacings = QUICK_SPACINGS if run.quick else SPACINGS[kind_of(device)]
        warm_up(presses[0], device)
        with several(run.options.processes) as workers:
            solved = {}
            for step, spacing in enumerate(spacings):
                # Processes share a GPU only for pairs of meshes.
                helpers = workers if device == "cpu" else None
                solved[spacing] = timed(presses, [spacing], device, helpers)
                run.progress((number + (step + 1) / (len(spacings) + 2)) / len(devices))
            rows += _rows(solved, reference)
            if workers is not None and (device != "cpu" or not run.quick):
                rows.append(_at_once(presses, reference, device, workers))
        run.progress((number + 1) / len(devices))
    run.spread = "single run of each"
    return rows


def write_reference(device: str) -> None:
    """Solve and store the forces that all others are compared with: minutes on a GPU."""
    tier = replace(
        numerics(REFERENCE_SPACING, device, REFERENCE_TOLERANCE),
        path_tolerance=None,
        augmentations=REFERENCE_AUGMENTATIONS,
    )
    presses = presses_at(REFERENCE_AT)
    outcomes = simulate_many([one.scene() for one in presses], tier, device=device)
    write_forces(forces_of(presses, outcomes))


def warm_up(one: TimedPress, device: str) -> None:
    """Load the kernels of both precisions: presses that fail in float32 are solved in float64."""
    ready_device(device)
    shallow = replace(one.scene(), motion=press([WARM]))
    for precision in ("float32", "float64"):
        simulate_many(
            [shallow], replace(numerics(4 / 3, device), precision=precision), device=device
        )


def timed(
    presses: Sequence[TimedPress],
    sizes: Sequence[float],
    device: str,
    workers: Workers | None,
    tolerance: float = TOLERANCE,
) -> tuple[list[Forces], Row]:
    """Return the forces by mesh, all solved at once by `workers`, and their row without errors."""
    scenes = [one.scene() for one in presses]
    tiers = [numerics(size, device, tolerance) for size in sizes]

    def work() -> list[list[Outcome]]:
        if workers is None:
            return [simulate_many(scenes, tier, device=device) for tier in tiers]
        calls = [submitted(workers, scenes, tier, device) for tier in tiers]
        return [gathered(workers, call) for call in calls]

    outcomes, spent = spent_by(work, device)
    row = {
        "device": device,
        "processes": 1 if workers is None else workers.processes,
        "meshes_mm": [round(size, 4) for size in sizes],
        "presses": len(presses),
        "seconds": rounded(spent.wall),
        "failed": sum(isinstance(one, SimulationDiverged) for one in outcomes[0]),
        "memory": spent.memory if workers is None else 0,
        "at_once": len(tiers) > 1,
    }
    return [forces_of(presses, some) for some in outcomes], row


def _rows(solved: dict[float, tuple[list[Forces], Row]], reference: Forces) -> list[Row]:
    """Return the rows of meshes, and of pairs of meshes, which take the time of both."""
    rows = [row | errors(forces, reference) for (forces,), row in solved.values()]
    for coarse, fine in combinations(solved, 2):
        ratio = coarse / fine
        if APART <= ratio <= APART_MOST:
            ((more,), coarser), ((less,), finer) = solved[coarse], solved[fine]
            both = extrapolated(less, more, ratio)
            rows.append(pair_of(coarser, finer) | errors(both, reference))
    return rows


def pair_of(coarse: Row, fine: Row) -> Row:
    """Return the row of two meshes whose forces are extrapolated, without its errors."""
    return fine | {
        "meshes_mm": [*fine["meshes_mm"], *coarse["meshes_mm"]],
        "seconds": rounded(coarse["seconds"] + fine["seconds"]),
        "failed": max(coarse["failed"], fine["failed"]),
        "memory": max(coarse["memory"], fine["memory"]),
    }


def _at_once(
    presses: Sequence[TimedPress], reference: Forces, device: str, workers: Workers
) -> Row:
    """Return the row of two meshes that several processes solve at once.

    A press without a solution on the coarser mesh, in which the indenter may stand, has the force
    of the finer one.
    """
    sizes = AT_ONCE[kind_of(device)]
    # A press for each process starts it and loads its kernels.
    timed(presses[: workers.processes], sizes, device, workers, AT_ONCE_TOLERANCE)
    (fine, coarse), row = timed(presses, sizes, device, workers, AT_ONCE_TOLERANCE)
    forces = fine | extrapolated(fine, coarse, sizes[1] / sizes[0])
    return row | errors(forces, reference)


# The page


def section(rows: Sequence[Row], page: Page) -> str:
    """Return the picture and the table of all meshes."""
    save_chart(
        page.picture("speed"),
        f"The paper's {rows[0]['presses']} presses\n"
        "discs: one mesh; diamonds: two meshes, extrapolated to zero element size",
        [
            _panel(rows, "mean", "mean error"),
            _panel(rows, "most", "95 % of the errors below"),
            _panel(rows, "worst", "worst error"),
        ],
        "time [s]",
        "error of the force [%]",
    )
    way = {1: "", 2: ", extrapolated"}
    lines = [
        [
            kind_of(row["device"]),
            " and ".join(f"{size:.3g}" for size in row["meshes_mm"])
            + (" mm at once" if row["at_once"] else " mm")
            + way[len(row["meshes_mm"])],
            row["processes"],
            seconds(row["seconds"]),
            seconds(row["seconds"] / row["presses"]),
            row["failed"],
            *(percent(row[name]) for name in ("mean", "most", "worst")),
            row["worst_at"] or "-",
        ]
        for row in unbeaten(rows)
    ]
    count = max(row["compared"] for row in rows)
    head = ["on", "elements", "processes", "all presses", "a press", "without a solution"]
    head += [f"mean error of {count} presses", "95 % below", "worst", "where"]
    return f"""## The paper's presses

{page.link("speed", "Error of the force against the time of all presses")}

18 indenters at 9 places, each to 5 depths of at most 1.5 mm, with friction 0.8, into the paper's
gel: {rows[0]["presses"]} presses.

{table(head, lines)}

Rows are those that no other on the same device beats in time and mean error. Elements are that
high, and 0.4 times as wide under the indenter. Errors are |F - Fref| / |Fref| from
{SHALLOW_MM:g} mm of depth on, over the {count} presses that a mesh of
{REFERENCE_SPACING:g} mm has solved, itself too large by about half a per cent. Seconds are from
scenes to results, kernels compiled and processes started; tolerance {TOLERANCE:g}, of two meshes at
once {AT_ONCE_TOLERANCE:g}. `nvidia-cuda-mps-control -d` before lets processes share a GPU."""


def unbeaten(rows: Sequence[Row]) -> list[Row]:
    """Return the rows that no other on the same device beats in time and mean error, by time."""
    compared = [row for row in rows if row["mean"] is not None]
    best = [
        row
        for row in compared
        if not any(
            other["mean"] < row["mean"] and other["seconds"] < row["seconds"]
            for other in chosen(compared, device=row["device"])
        )
    ]
    return sorted(best, key=lambda row: (row["device"], row["seconds"]))


def _panel(rows: Sequence[Row], measure: str, title: str) -> Panel:
    series = []
    for kind, colour in (("CPU", BLUE), ("GPU", RED)):
        for count, style, words in ((1, "o-", "one mesh"), (2, "D", "two meshes")):
            points = sorted(
                (row["seconds"], 100 * row[measure])
                for row in chosen(rows, kind)
                if len(row["meshes_mm"]) == count and row[measure] is not None
            )
            series.append(Series(f"{kind}, {words}", colour, style, points))
    return Panel(title, series)
