"""Cost of each effect, switched on and off, on one CPU core, and the table of effects.

Random scenes with effects are solved with all of them and without each on meshes that
follow the contact. `sim.effects_table` must agree within the uncertainty that it states.
"""

import inspect
import itertools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from benchmarks.accuracy.spent import spent_by
from benchmarks.accuracy.wording import Row, percent, rounded, seconds
from benchmarks.hard_cases.random_scenes.scenes import Drawn, drawn
from benchmarks.processes import OutOfTime, rows_of, time_limit
from benchmarks.report import Page, Run, table
from recorder.charts import BLUE, chart
from recorder.progress import span_of
from sim.device import ready_device
from sim.effect_sizes import SPREAD, changes, effects_table, variants
from sim.errors import SimulationDiverged
from sim.fem import Fem, balance, contact, element, lanes
from sim.fem.assembly import Assembly
from sim.fem.mesh import build_mesh
from sim.fem.stepping import path_of
from sim.indenters import sphere
from sim.result import Result
from sim.scene import Body, Effects, Friction, Gravity, Inertia, Motion, Scene, Viscosity
from sim.tiers import simulate, simulate_many

# Press in which an effect's cost is visible: small, half a millimetre down, then 0.15 mm sideways,
# in 1 ms, which is fast enough for inertia to matter.
BODY = Body(size_x=12e-3, size_y=12e-3, thickness=4e-3)
NUMERICS = Fem(spacing=1e-3, precision="float64")
MOTION = Motion(
    ((0.0, 0.0, 0.0), (0.0, 0.0, -0.5e-3), (0.15e-3, 0.0, -0.5e-3)), (0.0, 0.5e-3, 1e-3)
)
# Every effect, and its strength in words.
TRIALS: dict[str, tuple[Any, str]] = {
    "friction": (Friction(1.0), "coefficient 1"),
    "viscosity": (Viscosity((1.0, 0.5), (1e-3, 1.0)), "ratios 1 and 0.5"),
    "inertia": (Inertia(), "scale 1"),
    "gravity": (Gravity((300.0, 0.0, -500.0)), "300 and -500 m/s^2"),
}

# Pairs of runs, of which times are the minimum.
REPEATS, QUICK_REPEATS = 7, 1

# Number of random scenes whose table is checked, and most steps of each.
SCENES, SEED, STEPS_MAX = 60, 1, 40
# Full solves of these scenes, and the time in which all of a scene must end [s].
REFERENCE = Fem(fineness=0.4, elements_max=2000, tolerance=1e-3, path_tolerance=1e-2)
SECONDS = 60.0

# Arrays that tier `fem` keeps for each effect, as paths from the solver's `State`.
STATE: dict[str, tuple[str, ...]] = {
    "friction": ("contact.traction", "contact.traction_old", "contact.limit", "_limit_relaxed"),
    "viscosity": tuple(
        f"_branches.arrays.{bulk}{name}"
        for name in ("history", "rest", "branch")
        for bulk in ("", "bulk_")
    ),
    "inertia": ("predicted", "inertia_rate"),
    "gravity": ("weight",),
}


@dataclass(frozen=True, slots=True)
class Variant:
    """A kernel factory that compiles an effect's lines in where its flag is on."""

    factory: Callable[..., Any]
    flag: str

    def kernels(self, *, on: bool) -> list[Any]:
        """Return its kernels in float64 with the flag on or off and all other effects off."""
        names = inspect.signature(self.factory).parameters
        flags = {one.flag: False for some in KERNELS.values() for one in some if one.flag in names}
        variant = self.factory(wp.float64, **(flags | {self.flag: on}))
        return list(variant) if isinstance(variant, tuple) else [variant]

    def names_on(self) -> set[str]:
        """Return the names of the kernels that differ with the flag on."""
        off, on = ({one.module.name for one in self.kernels(on=on)} for on in (False, True))
        return on - off


# The code of each effect in kernels.
KERNELS: dict[str, tuple[Variant, ...]] = {
    "friction": (
        Variant(contact.contact_kernels, "friction"),
        Variant(balance.work_kernel, "friction"),
        Variant(balance.reading_kernels, "friction"),
    ),
    "viscosity": (
        Variant(element.element_kernels, "viscous"),
        Variant(element.element_rows_kernel, "viscous"),
        Variant(lanes.forces_kernel, "viscous"),
        Variant(lanes.blocks_kernel, "viscous"),
    ),
    "inertia": (
        Variant(balance.residual_kernel, "inertia"),
        Variant(balance.reading_kernels, "inertia"),
    ),
    "gravity": (
        Variant(balance.residual_kernel, "gravity"),
        Variant(balance.reading_kernels, "gravity"),
    ),
}


def scene(*names: str) -> Scene:
    """Return the press with the named effects, all others off."""
    effects = Effects(**{name: TRIALS[name][0] for name in names})
    return Scene(sphere(3e-3), MOTION, BODY, effects)


def measure(run: Run) -> dict[str, Any]:
    """Return the cost of each effect, and fail if one that is off leaves a trace.

    The base is a press without effects, before any effect was on in this process. A press without
    effects afterwards must launch the same kernels and have the same results, bit for bit; none of
    its kernels may have an effect's lines, and none of an effect's arrays may have a number.
    """
    ready_device("cpu")
    repeats = QUICK_REPEATS if run.quick else REPEATS
    with launched() as base:
        before = simulate(scene(), NUMERICS)
    costs = []
    for name in STATE:
        costs.append(cost(name, base, repeats))
        run.progress(0.2 * len(costs) / len(STATE))
    with launched() as again:
        after = simulate(scene(), NUMERICS)
    unchanged = again == base and same_results(before, after)
    if not unchanged:
        run.failures.append("a press without effects is another one after effects were on")
    for one in costs:
        if one["numbers_off"] or one["shared_kernels"]:
            run.failures.append(f"{one['name']} leaves a trace when it is off")
    count = 1 if run.quick else SCENES
    named = {one.name: one for one in scenes(count, run.folder)}
    rows = [*rows_of(run, table_errors, named, span_of(run.progress, 0.2, 0.8)).values()]
    run.seeds, run.spread = [SEED], f"minimum of {repeats} pairs of runs; single run of each scene"
    return {"kernels": len(base), "unchanged": unchanged, "effects": costs, "tables": rows}


def cost(name: str, base: set[str], repeats: int) -> dict[str, Any]:
    """Measure one effect against the press without effects, whose kernels are `base`."""
    with launched() as kernels:
        simulate(scene(name), NUMERICS)
    # A factory may make other kernels too, which have no line of the effect.
    compiled = {one for variant in KERNELS[name] for one in variant.names_on()}
    mesh = build_mesh(BODY, 1e-3)
    off, on = (
        Assembly([mesh], [one], NUMERICS, "float64", "cpu") for one in (scene(), scene(name))
    )
    return {
        "name": name,
        "kernels_on": len(kernels - base),
        "shared_kernels": len(compiled & base),
        "numbers_off": sum(stored(off.state, path) for path in STATE[name]),
        "numbers_on": sum(stored(on.state, path) for path in STATE[name]),
        "time": round(_ratio(scene(name), scene(), repeats), 3),
    }


@contextmanager
def launched() -> Iterator[set[str]]:
    """Collect the names of the kernels that are launched inside the context."""
    launch, names = wp.launch, set[str]()

    def noted(kernel: Any, *arguments: Any, **options: Any) -> Any:
        names.add(kernel.module.name)
        return launch(kernel, *arguments, **options)

    wp.launch = noted
    try:
        yield names
    finally:
        wp.launch = launch


def stored(state: Any, path: str) -> int:
    """Return how many numbers the state has in an array; 0 without an array."""
    array = state
    for name in path.split("."):
        array = getattr(array, name)
        if array is None:
            return 0
    return int(np.asarray(array).size)


def same_results(one: Result, two: Result) -> bool:
    """Return true if forces, surfaces, tractions and the solver's counts are the same bits."""
    pairs = [(getattr(one, name), getattr(two, name)) for name in ("wrench", "surface", "traction")]
    pairs += [
        (getattr(one.quality, name), getattr(two.quality, name)) for name in one.quality.__slots__
    ]
    return all(bool(np.array_equal(a, b, equal_nan=True)) for a, b in pairs)


def _ratio(one: Scene, other: Scene, repeats: int) -> float:
    """Return the CPU time of one press over that of another, with kernels compiled."""

    def spent(scene: Scene) -> float:
        return spent_by(lambda: simulate(scene, NUMERICS), "cpu")[1].cpu

    pairs = [(spent(one), spent(other)) for _ in range(repeats)]
    return min(first for first, _ in pairs) / min(second for _, second in pairs)


# Tables of random scenes, beside full solves.

# Numbers of a table that have an uncertainty, with their unit.
QUANTITIES = {"force": "%", "marker": "px"}


def scenes(count: int, folder: Path) -> list[Drawn]:
    """Return scenes with contact, an effect or more, and few steps."""
    some = (drawn(SEED, index, folder) for index in itertools.count())
    brief = (one for one in some if one.scene.effects.key and one.scene.motion.depth_max > 0)
    few = (one for one in brief if path_of(one.scene, Fem()).steps <= STEPS_MAX)
    return [*itertools.islice(few, count)]


def table_errors(one: Drawn) -> Row:
    """Return the table of a scene, and the changes in full solves that leave each effect out."""
    stated, spent = spent_by(partial(effects_table, one.scene), "cpu")
    row: Row = {"scene": one.name, "seconds": rounded(spent.cpu), "effects": []}
    scenes = variants(one.scene)
    try:
        with time_limit(SECONDS):
            outcomes = dict(zip(scenes, simulate_many([*scenes.values()], REFERENCE), strict=True))
            results = {name: one for name, one in outcomes.items() if isinstance(one, Result)}
            noise = changes(results["all"], results["hardly"])
            _full, whole = spent_by(partial(simulate, one.scene, REFERENCE), "cpu")
            for size in stated.record()["effects"]:
                true = changes(results["all"], results[size["name"]])
                less = replace(one.scene.effects, **{size["name"]: None})
                off = replace(one.scene, effects=less)
                _less, spent = spent_by(partial(simulate, off, REFERENCE), "cpu")
                size |= {"time_true": 1.0 - spent.cpu / whole.cpu}
                for quantity, value, unsure in zip(QUANTITIES, true, noise, strict=True):
                    size |= {f"{quantity}_true": value, f"{quantity}_noise": SPREAD * unsure}
                row["effects"].append(size)
    except (SimulationDiverged, OutOfTime, KeyError) as error:
        row["reported"] = str(error)
    return row


def compared(rows: Sequence[Row], quantity: str) -> list[tuple[float, float]]:
    """Return the error of each number of a quantity, and its and its reference's uncertainty."""
    every = [one for row in rows for one in row["effects"] if one[quantity] is not None]
    return [
        (
            abs(one[quantity] - one[f"{quantity}_true"]),
            one[f"{quantity}_unsure"] + one[f"{quantity}_noise"],
        )
        for one in every
    ]


# The page


def section(values: dict[str, Any], page: Page) -> str:
    """Return the picture and the table of effects."""
    costs = values["effects"]
    with chart(page.picture("effects"), 4.8, 2.2) as figure:
        axes = figure.add_subplot()
        names = [one["name"] for one in costs]
        axes.barh(names, [one["time"] for one in costs], color=BLUE)
        axes.axvline(1.0, color="black", linewidth=0.8)
        axes.set(xlabel="time of the press with the effect over that without")
        axes.invert_yaxis()
    rows = [
        [
            f"{one['name']}, {TRIALS[one['name']][1]}",
            one["numbers_off"],
            f"{one['numbers_on']:,}",
            one["shared_kernels"],
            one["kernels_on"],
            f"{one['time']:.2f}",
        ]
        for one in costs
    ]
    head = ["effect", "numbers of state, off", "on", "its kernels, off", "on", "time, on / off"]
    after = "the same kernels and the same bits" if values["unchanged"] else "**another result**"
    return f"""## Effects

{page.link("effects", "Time of a press with each effect over that without")}

{table(head, rows)}

An effect that is off costs nothing: no number of its state is stored, none of the
{values["kernels"]} kernels of a press without effects has its lines, and after presses with every
effect that press has {after}. One press of 0.5 mm and 0.15 mm aside into 576
elements in double precision, one CPU core; viscosity has two branches.

{tables(values.get("tables", []))}"""


def tables(rows: Sequence[Row]) -> str:
    """Return how well the tables of random scenes agree with full solves, in words."""
    if not rows:
        return ""
    solved = [row for row in rows if "reported" not in row]
    text = (
        f"**The table of effects** (`sim.effects_table`) of {len(rows)} random scenes, of which "
        f"{len(solved)} have full solutions with all effects and without each: "
    )
    every = [one for row in rows for one in row["effects"]]
    for quantity, unit in QUANTITIES.items():
        pairs, factor = compared(rows, quantity), 100 if unit == "%" else 1
        errors = [factor * error for error, _ in pairs] or [0.0]
        within = sum(error <= unsure for error, unsure in pairs)
        text += (
            f"{quantity}s differ by {np.median(errors):.2g} {unit} in the median and "
            f"{max(errors):.2g} {unit} at most, {within} of {len(pairs)} within what both state, "
            f"{len(every) - len(pairs)} unknown; "
        )
    timed = [one for one in every if one["time"] is not None]
    times = [abs(one["time"] - one["time_true"]) for one in timed] or [0.0]
    spent = [row["seconds"] for row in rows]
    return (
        f"{text}times by {percent(float(np.median(times)))} of the whole in the median. A table "
        f"took {seconds(float(np.median(spent)))} in the median, {seconds(max(spent))} at most."
    )
