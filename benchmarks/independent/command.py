"""Forces of `sim` beside solutions by other methods: `python -m benchmarks independent`."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from benchmarks.independent.comparison import compared, scene_of
from benchmarks.independent.linear_layer import LinearLayer, layer_sphere
from benchmarks.independent.presses import PRESSES, Press, store
from benchmarks.independent.references import interpreter
from benchmarks.independent.references import solved as solved_again
from benchmarks.processes import add_processes, rows_of
from benchmarks.report import Benchmark, Page, Part, Run, table
from recorder.charts import BLUE, GREEN, INK, ORANGE, PURPLE, RED, SKY, chart
from sim.device import ready_device
from sim.fem import Fem
from sim.indenters import sphere
from sim.layer import Layer
from sim.scene import Body, Scene
from sim.scene import press as pressing
from sim.tiers import simulate

# Error that counts as small [%], beside the uncertainty of the other solution.
WITHIN = 3.0
TOLERANCE = "1 %"
# Each tier and its coarse form; a quick run has axisymmetric cases with and without friction, and
# one of GetFEM.
SOLVERS: dict[str, tuple[Fem | Layer | str, Fem | Layer | str]] = {
    "layer": (Layer(), Layer()),
    "fem": (Fem(), Fem(fineness=0.3)),
    TOLERANCE: (TOLERANCE, "15 %"),
}
QUICK = ("sphere 4 in 4, mu 0, nu 0.45, to 1.5", "sphere 2 in 2, mu 0.3", "two spheres 2")
# The press that a quick run solves again, and how exactly all must repeat [%].
AGAIN, REPEATS = "sphere 4 in 4, mu 0, nu 0.45, to 0.005", 0.1
# Spheres on the gel of the paper by radius, and depths, over the gel's thickness.
RADII, DEPTHS = (0.5, 1.0, 5.0), (0.01, 0.03, 0.1, 0.3)
COLORS = (BLUE, ORANGE, GREEN, RED, PURPLE, SKY, INK)
# Forces beside stored ones.


def presses(tier: str, run: Run) -> dict[str, Any]:
    """Compare the forces of a tier, or to a tolerance, with all that are stored."""
    ready_device(run.device)
    chosen = [press for press in PRESSES if not run.quick or press.name.startswith(QUICK)]
    solve = partial(compared, SOLVERS[tier][run.quick], run.device)
    # Slender and small contacts take longest: they begin first.
    longest = sorted(chosen, key=lambda press: scene_of(press).indenter.narrowest)
    by_name = rows_of(run, solve, {press.name: press for press in longest})
    rows = [row for press in chosen for row in by_name[press.name]]
    return {"tier": tier, "processes": run.options.processes, "rows": rows}


def solved(rows: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any]]:
    """Return the rows of presses that were solved."""
    return [row for row in rows if row["error_percent"] is not None]


def covered(row: Mapping[str, Any]) -> bool:
    """Return True if the stated error and the reference's uncertainty contain the error."""
    stated = row["stated_percent"]
    return stated is not None and abs(row["error_percent"]) <= stated + row["truth_percent"]


def inside(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return how many of the forces with a stated error are covered by it."""
    stating = [row for row in solved(rows) if row["stated_percent"] is not None]
    return f"{sum(map(covered, stating))} of {len(stating)}"


def figures(values: Mapping[str, Any], count: int) -> list[str]:
    """Return a row of the table of tiers, which has `count` forces."""
    rows, right = values["rows"], solved(values["rows"])
    of = [_title(values["tier"]), f"{len(right)} of {count}"]
    if not right:
        return [*of, *("-" for _ in range(6))]
    errors = np.abs([row["error_percent"] for row in right])
    near = errors <= WITHIN + np.array([row["truth_percent"] for row in right])
    seconds = [*{row["case"]: row["seconds"] for row in rows}.values()]
    middle, high, largest = np.quantile(errors, (0.5, 0.9, 1.0))
    return [
        *of,
        *(f"{error:.2f} %" for error in (middle, high, largest)),
        f"{near.sum()} of {len(right)}",
        inside(rows),
        f"{np.median(seconds):.1f} s, {max(seconds):.0f} s",
    ]


def _title(tier: str) -> str:
    return f"`{tier}`" if tier in ("layer", "fem") else f"to {tier}"


def summary(values: dict[str, Any]) -> str:
    """Return the table of tiers."""
    tiers = [values[name] for name in ("layer", "fem", "tolerance") if name in values]
    if not tiers:
        return ""
    truths = max(([row["truth_percent"] for row in tier["rows"]] for tier in tiers), key=len)
    rows = [figures(tier, len(truths)) for tier in tiers]
    planned = f' "To {TOLERANCE}" is `plan(scene, "{TOLERANCE}")`.' if "tolerance" in values else ""
    head = ["forces by", "solved", "median error", "90 % below", "largest", f"within {WITHIN:g} %"]
    head += ["inside the stated error", "a press: median, longest"]
    return f"""{table(head, rows)}

`layer` is the linear layer, `fem` the default elements.{planned} An error is the difference from
the other method's force over that force. "Within" and "inside" allow for the other method's own
uncertainty: {np.median(truths):.2g} % in the median, at most {max(truths):.2g} %. The stated error
is `record["error"]["percent"]`, one for all forces of a press; "inside" counts those with one.

## The other methods
Neither shares code with `sim`; both have its material law and the exact outline of each indenter.

- Axisymmetric: finite elements of second order with a separate dilatation, on a mesh graded to the
  contact: spheres of 0.5 to 20 mm, punches, cones and rings in gels of 0.5 to 20 mm, from 5 um to
  0.4 thicknesses deep, Coulomb friction 0 to 1, Poisson's ratio 0.3 to 0.49. The uncertainty is
  the difference from a mesh of half the elements, plus half of what the square body's corners can
  add, plus twice the penetration that is left.
- GetFEM (getfem.org), hexahedra of second order: a sphere near the edge, beyond the rim, on a dome,
  on a thin gel and dragged with friction; two spheres, a box, a blade, upright and leaning bars, a
  leaning punch. The uncertainty is the difference from a coarser mesh. It runs where an interpreter
  has it (Debian: `python3-getfem`; `FOREIGN_PYTHON` names another one), and is stored.
"""


def tier_section(values: dict[str, Any], page: Page) -> str:
    """Return the errors by form, and the forces outside the stated error; `fem` has a picture."""
    rows, tier, right = values["rows"], values["tier"], solved(values["rows"])
    lines: list[list[object]] = []
    for kind in dict.fromkeys(row["kind"] for row in rows):
        these = [row for row in rows if row["kind"] == kind]
        errors = [abs(row["error_percent"]) for row in solved(these)]
        cells = (f"{np.median(errors):.2f} %", f"{max(errors):.2f} %") if errors else ("-", "-")
        cases = len({row["case"] for row in these})
        lines.append([kind, cases, len(these), *cells, inside(these)])
    head = ["indenter", "presses", "forces", "median error", "largest", "inside the stated error"]
    texts = [f"## {_title(tier)}", table(head, lines)]
    if no_contact := sum(row["force_n"] == 0 for row in right):
        why = "a contact smaller than the pixels, which grow with the body, so that none touches"
        texts.append(f"{no_contact} forces are 0, an error of 100 %: {why}.")
    if outside := [row for row in right if not covered(row)]:
        outside.sort(key=lambda row: -abs(row["error_percent"]))
        rim = []
        for row in outside[:6]:
            off, stated = f"{row['error_percent']:+.2f} %", row["stated_percent"]
            states = "none" if stated is None else f"{stated:.2f} %"
            unsure = f"{row['truth_percent']:.2f} %"
            rim.append([row["case"], f"{row['depth_mm']:.3g}", off, states, unsure])
        head = ["press", "depth [mm]", "error", "stated", "uncertainty of the other"]
        more = f" (the {len(rim)} largest)" if len(outside) > len(rim) else ""
        none = sum(row["stated_percent"] is None for row in outside)
        counts = f"{len(outside) - none}; without one: {none}{more}"
        texts += [f"Forces outside the stated error: {counts}.", table(head, rim)]
    reasons = {row["case"]: row["reason"].partition("\n")[0] for row in rows if row["reason"]}
    texts += [f"No solution of {case}: {reason}" for case, reason in reasons.items()]
    if tier == "fem" and right:
        draw(right, page)
        texts.append(page.link("fem", "Error of each force beside the error that is stated"))
    return "\n\n".join(texts)


def draw(rows: Sequence[Mapping[str, Any]], page: Page) -> None:
    """Draw the error of each force beside the error that its result states."""
    with chart(page.picture("fem"), 7.0, 4.2) as figure:
        axes = figure.subplots()
        for index, kind in enumerate(dict.fromkeys(row["kind"] for row in rows)):
            these = [row for row in rows if row["kind"] == kind and row["stated_percent"]]
            error = np.maximum([abs(row["error_percent"]) for row in these], 0.01)
            bars = [row["truth_percent"] for row in these]
            axes.errorbar(
                [row["stated_percent"] for row in these],
                error,
                yerr=[np.minimum(bars, 0.9 * error), bars],
                fmt="os^Dv"[index // len(COLORS)],
                color=COLORS[index % len(COLORS)],
                ms=4,
                lw=0.7,
                label=kind,
            )
        axes.plot([0.03, 100], [0.03, 100], color=INK, lw=0.9, ls="--")
        axes.text(22, 30, "error = stated", fontsize=8, ha="right")
        axes.set(xscale="log", yscale="log", xlim=(0.2, 40), ylim=(0.008, 40))
        axes.set_xlabel("error that the result states [%]")
        axes.set_ylabel("difference from the other method [%]")
        axes.set_title("Forces of fem; bars: uncertainty of the other method")
        axes.legend(loc="lower right", ncols=2, fontsize=8)


# The integral equation of a linear layer.


def formulas(run: Run) -> list[dict[str, float]]:
    """Compare spheres on the paper's gel with the integral equation of a linear layer."""
    ready_device(run.device)
    rows: list[dict[str, float]] = []
    for radius in RADII[1:2] if run.quick else RADII:
        rows += run.once(f"radius {radius:g}", partial(_sphere, run, radius))
        run.progress(len(rows) / (len(RADII) * len(DEPTHS)))
    return rows


def _sphere(run: Run, radius: float) -> list[dict[str, float]]:
    """Return the force at each depth, and the differences of `layer` and `fem` from it."""
    thickness = Body().thickness
    body = Body(14 * thickness, 14 * thickness)
    layer = LinearLayer(thickness, body.modulus, body.poisson)
    depths = [thickness * depth for depth in DEPTHS if depth < radius]
    exact = np.array([layer_sphere(depth, radius * thickness, layer).force for depth in depths])
    scene = Scene(sphere(radius * thickness), pressing(depths), body)
    fem = Fem(fineness=0.3 if run.quick else 1.0)
    results = simulate(scene, Layer(grid=256)), simulate(scene, fem, device=run.device)
    off = [(-result.force[1:, 2] / exact - 1).tolist() for result in results]
    both = zip(depths, exact.tolist(), *off, strict=True)
    return [
        {"radius": radius, "depth": depth / thickness, "exact_n": force, "layer": one, "fem": other}
        for depth, force, one, other in both
    ]


def formulas_section(rows: list[dict[str, float]], _: Page) -> str:
    """Return the table of spheres on a linear layer."""
    lines = [
        [f"{row['radius']:g}", f"{row['depth']:g}", f"{row['exact_n']:.4g}"]
        + [f"{100 * row[tier]:+.2f} %" for tier in ("layer", "fem")]
        for row in rows
    ]
    head = ["radius over thickness", "depth over thickness", "exact, linear [N]"]
    return f"""## Beside the exact linear layer
A sphere on a layer of 4 mm and 145 kPa, 14 thicknesses wide, by the integral equation of a bonded
layer, which is exact for small strain. `layer` (256 pixels) solves the same equations, so its
difference is that of its pixels; that of `fem` is also what large strain adds.

{table([*head, "`layer`", "`fem`"], lines)}
"""


# The other solutions, again.


def references(run: Run) -> dict[str, Any]:
    """Solve the presses by the other methods again, and add forces that are not stored."""
    chosen = {
        press.name: press
        for press in PRESSES
        if (press.name == AGAIN if run.quick else press.axisymmetric or interpreter())
    }
    added, differences = dict[str, Press](), dict[str, float]()
    for name, row in rows_of(run, solved_again, chosen).items():
        press, forces = chosen[name], np.array(row["forces_n"])
        if len(forces) < len(press.path):
            run.failures.append(f"{name}: not solved again")
        elif not press.forces_n:
            added[name] = replace(press, **row)
        else:
            off = np.linalg.norm(forces - press.forces_n, axis=1)
            each = off / np.linalg.norm(press.forces_n, axis=1)
            differences[name] = 100 * float(each.max())
            if differences[name] > REPEATS:
                run.failures.append(f"{name}: {differences[name]:.2f} % from the stored force")
    if added:
        store([added.get(press.name, press) for press in PRESSES])
    return {"differences_percent": differences}


def references_section(values: dict[str, Any], _: Page) -> str:
    """Return whether the other solutions repeat."""
    again = values["differences_percent"]
    most = f", the largest difference of a force is {max(again.values()):.1g} %" if again else ""
    return f"## The other methods again\n\nPresses solved again: {len(again)}{most}."


BENCHMARK = Benchmark(
    name="independent",
    title="Forces beside solutions by other methods",
    question=(
        "How far are forces of each tier from solutions by methods that share no code with it, "
        "and does the error that a result states contain the difference?"
    ),
    parts=[
        Part("layer", partial(presses, "layer"), tier_section, weight=1),
        Part("fem", partial(presses, "fem"), tier_section, weight=20),
        Part("tolerance", partial(presses, TOLERANCE), tier_section, weight=60),
        Part("formulas", formulas, formulas_section, weight=2),
        Part("references", references, references_section, weight=25),
    ],
    summary=summary,
    options=add_processes,
    on_device=True,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
