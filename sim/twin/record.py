"""Files of a twin: its row as YAML, and a picture of the forces beside the twin's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from recorder.charts import BLUE, INK, ORANGE, RED, SOFT, chart
from recorder.strict_yaml import yaml_text
from sim.twin.fit import Fit, is_log
from sim.twin.observations import Track
from sim.twin.plan import Planner, Presses, cost

# Quantities as people write them: factor from SI, and unit.
SHOWN = {
    "modulus": (1e-3, "kPa"),
    "thickness": (1e3, "mm"),
    "time": (1.0, "s"),
    "height": (1e6, "um"),
    "compliance": (1e6, "um/N"),
    "turn": (180 / math.pi, "deg"),
    "tilt": (180 / math.pi, "deg"),
}
# Correlations from this on are listed.
STRONG = 0.7
# Most tracks that are drawn.
DRAWN = 4


def twin_yaml(fit: Fit, design: str, sessions: Sequence[str]) -> str:
    """Return the row of a twin, which extends the design's file or row `design`."""
    sensor = fit.sensor
    body, effects, posterior = sensor.body, sensor.effects, sensor.posterior
    assert posterior is not None
    assert effects.viscosity is not None
    assert effects.friction is not None
    content: dict[str, Any] = {
        "extends": design,
        "description": f"Twin of a sensor, identified from {', '.join(sessions)}",
        "body": {
            "thickness_mm": _round(1e3 * body.thickness),
            "modulus_kpa": _round(1e-3 * body.modulus),
            "poisson": _round(body.poisson),
        },
        "effects": {
            "friction": {"coefficient": _round(effects.friction.coefficient)},
            "viscosity": {
                "ratios": [_round(ratio) for ratio in effects.viscosity.ratios],
                "times_s": [_round(time) for time in effects.viscosity.times],
                "relaxes": effects.viscosity.relaxes,
            },
        },
        "depth_max_mm": _round(1e3 * sensor.depth_max),
        "posterior": {
            "names": list(posterior.names),
            "spreads": [_round(spread) for spread in posterior.spreads],
            "correlations": [[round(each, 4) for each in row] for row in posterior.correlations],
        },
    }
    if sensor.trajectory is None:
        content["trajectory"] = None
    if sensor.force_depth is None:
        content["force_depth"] = None
    return yaml_text(content)


def lines(fit: Fit) -> list[str]:
    """Return the fitted values with 90 % intervals, strong correlations, and errors of the fit."""
    found = [f"{'quantity':<12}{'value':>10}  {'90 % interval':<22}"]
    for name in fit.names:
        factor, unit = SHOWN.get(name.partition("_")[0], (1.0, ""))
        low, high = fit.interval(name)
        note = "  not told by these presses, the prior's" if name in fit.untold else ""
        if name == "friction" and note:
            note = f"  at least {least_friction(fit.tracks):.2f}: it hardly slipped"
        found.append(
            f"{name:<12}{factor * fit.values[name]:>10.4g}  "
            f"{f'{factor * low:.4g} to {factor * high:.4g}':<15} {unit:<5}{note}"
        )
    spread = np.sqrt(np.diag(fit.covariance))
    matrix = fit.covariance / np.outer(spread, spread)
    pairs = [
        f"{fit.names[a]} and {fit.names[b]} {matrix[a, b]:+.2f}"
        for a in range(len(matrix))
        for b in range(a)
        if abs(matrix[a, b]) >= STRONG
    ]
    found.append(f"correlations above {STRONG:g}: {', '.join(pairs) or 'none'}")
    found.append(
        f"misfit {100 * fit.misfit:.2f} % of the forces at rest; error of the law "
        f"{100 * fit.law:.2f} %; moving forces are {1e3 * fit.latency:.0f} ms late, timing "
        f"{1e3 * fit.timing:.0f} ms"
    )
    return found


def plan_files(planned: Sequence[Presses], bench: str) -> dict[str, str]:
    """Return the text of each file of a plan: a bench for each session, and `campaign.yaml`.

    Args:
        planned: Presses of each session.
        bench: Bench file that presses, relative to the plan's folder.
    """
    files, entries = {}, []
    for number, each in enumerate(planned, 1):
        name = f"twin-{number}"
        plan = each.plan
        trajectory = {
            "kind": plan.kind,
            "points": list(plan.points),
            "depth_step_mm": _round(1e3 * plan.depth_step),
            "depth_max_mm": _round(1e3 * plan.depth_max),
            "angle_step_deg": _round(math.degrees(plan.angle_step)),
            "shear_mm": _round(1e3 * plan.shear),
        }
        files[f"{name}.yaml"] = yaml_text(
            {
                "extends": bench,
                "indenter": each.indenter,
                "hold_ms": _round(1e3 * each.hold),
                "trajectory": trajectory,
            }
        )
        entries.append({"sensor": name, "indenter": each.indenter})
    files["campaign.yaml"] = yaml_text({"sessions": entries})
    return files


def expected_lines(
    planner: Planner, planned: Sequence[Presses], usual: Sequence[Presses], change: float
) -> list[str]:
    """Return the sessions of a plan, and the 90 % intervals to expect with and without it."""
    found = [
        f"{each.indenter}: depth {' and '.join(f'{1e3 * depth:.3g}' for depth in each.depths)} mm, "
        f"shear {1e3 * each.plan.shear:.3g} mm, hold {each.hold:.2g} s"
        for each in planned
    ]
    columns = {"plan": planned, "sphere, prism": usual}
    found.append(f"{'90 % interval, +-':<20}" + "".join(f"{name:>16}" for name in columns))
    spreads = [planner.expected(each).spreads for each in columns.values()]
    for name in planner.names:
        factor, unit = SHOWN.get(name.partition("_")[0], (1.0, ""))
        factor, unit = (100.0, "%") if is_log(name) else (factor, unit)
        found.append(
            f"{f'{name} [{unit}]' if unit else name:<20}"
            + "".join(f"{1.645 * factor * each[name]:>16.3g}" for each in spreads)
        )
    for label, count in (
        ("presses", lambda part: sum(len(each.plan) for each in part)),
        ("seconds", lambda part: round(sum(each.seconds for each in part))),
        ("with changes", lambda part: round(cost(part, change))),
    ):
        found.append(f"{label:<20}" + "".join(f"{count(each):>16}" for each in columns.values()))
    return found


def least_friction(tracks: Sequence[Track]) -> float:
    """Return the largest shear over normal force at rest: friction is at least that."""
    most = 0.0
    for track in tracks:
        normal, shear = -track.force[:, 2], np.hypot(track.force[:, 0], track.force[:, 1])
        sure = track.rest & track.contact & (normal > 0.3 * normal.max(initial=0.0))
        most = max(most, float((shear[sure] / normal[sure]).max(initial=0.0)))
    return most


def summary(fit: Fit) -> dict[str, Any]:
    """Return the result as plain values in SI, for programs."""
    return {
        "values": {name: fit.values[name] for name in fit.names},
        "intervals_90": {name: list(fit.interval(name)) for name in fit.names},
        "spreads": fit.spreads,
        "logarithmic": [name for name in fit.names if is_log(name)],
        "untold": list(fit.untold),
        "misfit": fit.misfit,
        "law": fit.law,
        "timing": fit.timing,
        "latency": fit.latency,
        "rounds": fit.rounds,
    }


def draw(fit: Fit, path: Path, title: str) -> None:
    """Draw the forces of each track beside the twin's, and their differences, as a picture."""
    drawn = fit.tracks[:DRAWN]
    with chart(path, 11.0, 2.6 * len(drawn) + 0.8) as figure:
        axes = figure.subplots(len(drawn), 2, squeeze=False, width_ratios=(2, 1))
        for row, track in enumerate(drawn):
            left, right = axes[row]
            used = track.contact
            order = np.arange(int(used.sum()))
            force, read = track.force[used], fit.readings[row][used]
            for axis, colour in zip((0, 1, 2), (ORANGE, RED, BLUE), strict=True):
                left.plot(order, force[:, axis], ".", color=colour, markersize=3)
                left.plot(order, read[:, axis], "-", color=colour, label=f"F{'xyz'[axis]}")
            left.set_title(f"{track.name}, {track.indenter}: measured (dots) and twin (lines)")
            left.set_ylabel("force [N]")
            rest = track.rest[used]
            off = np.linalg.norm(force - read, axis=1)
            depth = -1e3 * track.tip[used, 2]
            right.plot(depth[~rest], 1e3 * off[~rest], ".", color=SOFT, label="moving")
            right.plot(depth[rest], 1e3 * off[rest], ".", color=INK, label="at rest")
            right.set_ylabel("difference [mN]")
        axes[0, 0].legend(loc="lower left", ncols=3)
        axes[0, 1].legend(loc="upper left")
        axes[-1, 0].set_xlabel("points in contact, in order")
        axes[-1, 1].set_xlabel("depth [mm]")
        figure.suptitle(title)


def _round(value: float) -> float:
    return float(f"{value:.6g}")
