"""The table of all groups, from the weakest way to the strongest, and a section for each group."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.gauge.ladder import (
    AT_PLACES,
    BY_TWIN,
    DISPLACED,
    MEAN,
    NEAREST,
    OWN,
    SOURCE,
    TRANSLATED,
)
from benchmarks.report import Page, table
from recorder.charts import chart

Line = Mapping[str, Any]
TITLES = {"kinds": "three kinds of sensors", "skins": "three skins", "patterns": "three patterns"}
_PAIRED = "the same places pressed on both sensors"
# What each way has that a bench with a bare sensor may not have.
PRIVILEGES = {
    MEAN: "none",
    NEAREST: f"{_PAIRED}; a force-depth curve of both",
    SOURCE: "none",
    DISPLACED: "none",
    f"{DISPLACED}, {AT_PLACES[1]}": "a force-depth curve of both",
    f"{DISPLACED}, {AT_PLACES[2]}": "a twin of both",
    f"{TRANSLATED}, {AT_PLACES[1]}": f"{_PAIRED}; a force-depth curve of both",
    f"{TRANSLATED}, {AT_PLACES[2]}": f"{_PAIRED}; a twin of both",
    BY_TWIN: "places and depths of its presses; a twin, with the surface's height",
    OWN: "**a force at each frame**",
}
_ORDER = [*PRIVILEGES, *AT_PLACES]
# Difference of R2 to own labels that the project aims at.
GOAL = 0.03


def best_net(lines: Sequence[Line], way: str) -> Line | None:
    """Return the line of a way whose net is best; None without one."""
    own = [line for line in lines if line["way"] == way and math.isfinite(line["sealed"])]
    return max(own, key=lambda line: float(line["sealed"]), default=None)


def number(value: Any) -> str:
    """Return a number with three digits; `-` for none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.3f}"


def summary(values: Mapping[str, Any]) -> str:
    """Return the ladder of the groups that have a drawn indenter, and its conclusion."""
    groups = {name: values[name]["lines"] for name in TITLES if name in values}
    groups = {name: lines for name, lines in groups.items() if best_net(lines, OWN)}
    heads = [f"R2, {TITLES[name]} (twins by `{values[name]['fit']}`)" for name in groups]
    if not groups:
        return ""
    lines = []
    for way, privilege in PRIVILEGES.items():
        of_groups = [best_net(group, way) for group in groups.values()]
        there = [line for line in of_groups if line is not None]
        if there:
            spent = sorted({line["spent"] for line in there})
            presses = f"{spent[0]} to {spent[-1]}" if len(spent) > 1 else str(spent[0])
            lines.append([way, *map(_short, of_groups), presses, privilege])
    head = ["way", *heads, "presses with a gauge", "what it is given besides"]
    return f"""\
R2 is the mean of Fx, Fy, Fz on **drawn indenters that no training, twin or choice saw**, of all
pairs of sensors and all seeds; of a way's best net, with its 95 % interval. All in simulation.
Sensors are planted: modulus, thickness, Poisson's ratio, viscosity and friction differ from their
designs, and they are mounted and seen with errors. No way uses a simulator's true displacement.

{table(head, lines)}

{_verdicts(groups)}"""


def section(name: str, values: Mapping[str, Any], page: Page) -> str:
    """Return the table of a group, and its twins; the picture is of the first group."""
    texts = []
    lines = sorted(values["lines"], key=lambda line: _ORDER.index(line["way"]))
    for line in lines:
        words = line["way"] if line["net"] == "-" else f"{line['way']} (`{line['net']}`)"
        if line["way"] in AT_PLACES:
            words = f"no net, true places: {words}"
        interval = f"{number(line['sealed_low'])} to {number(line['sealed_high'])}"
        errors = f"{number(line['mae_shear_n'])}, {number(line['mae_fz_n'])}"
        row = [words, line["pairs"], line["spent"], number(line["sealed"]), interval]
        texts.append([*row, number(line["paper"]), errors])
    head = ["way (net)", "pairs", "presses", "R2", "95 % interval", "R2, the paper's six"]
    picture = ""
    if name == "kinds":
        _draw(lines, page)
        picture = page.link("ladder", "R2 of each way between kinds, with its interval")
    return "\n\n".join(
        text
        for text in (
            f"## {TITLES[name].capitalize()}",
            f"Planted from {', '.join(values['designs'])}, seed {values['skins']}; true forces and "
            f"frames by tier `{values['truth']}`, twins by tier `{values['fit']}`. "
            f"{values.get('note', '')}".strip(),
            table([*head, "MAE of shear, Fz [N]"], texts),
            picture,
            _twins(values["twins"]),
        )
        if text
    )


def _short(line: Line | None) -> str:
    if line is None:
        return "-"
    interval = f"{number(line['sealed_low'])} to {number(line['sealed_high'])}"
    return f"{number(line['sealed'])} ({interval})"


def _verdicts(groups: Mapping[str, Sequence[Line]]) -> str:
    """Return a sentence on the ways without a gauge press, and one on the twin's forces."""
    bare, below = [], []
    for name, lines in groups.items():
        free = [line for line in lines if line["way"] in PRIVILEGES and not line["spent"]]
        best = max(free, key=lambda each: float(each["sealed"]), default=None)
        if best is not None:
            words = "no way works, the best has" if best["sealed"] < 0 else "the best way has"
            bare.append(f"{TITLES[name]}: {words} R2 {number(best['sealed'])} ({best['way']})")
        line = best_net(lines, BY_TWIN)
        if line is not None and best_net(lines, OWN) is not None:
            low, high = number(line.get("below_low")), number(line.get("below_high"))
            interval = f" (95 % interval {low} to {high})" if low != "-" else ""
            goal = f"{'within' if line['below'] <= GOAL else 'not within'} the aim of {GOAL:g}"
            below.append(f"{TITLES[name]}: {line['below']:.3f}{interval}, {goal}")
    heads = (
        ("**With no gauge press on the target**", bare),
        ("Below own labels, by own frames with the forces of a twin", below),
    )
    return "\n\n".join(f"{head}: {'; '.join(of)}." for head, of in heads if of)


def _twins(twins: Mapping[str, Mapping[str, float]]) -> str:
    """Return the range of the errors of the fitted quantities, in a sentence."""
    if not twins:
        return ""
    words = []
    for name, factor, unit in (
        ("modulus", 100, " %"),
        ("thickness", 100, " %"),
        ("poisson", 1, ""),
        ("friction", 100, " %"),
        ("height", 1e6, " um"),
    ):
        errors = [factor * each[name] for each in twins.values() if name in each]
        if errors:
            digits = ".3f" if factor == 1 else ".1f"
            words.append(f"{name} {min(errors):+{digits}} to {max(errors):+{digits}}{unit}")
    misfits = [each["misfit"] for each in twins.values()]
    return (
        f"Errors of the twins: {', '.join(words)}; misfit of resting forces {min(misfits):.3f} to "
        f"{max(misfits):.3f}."
    )


def _draw(lines: Sequence[Line], page: Page) -> None:
    ways = [(way, best_net(lines, way)) for way in reversed(PRIVILEGES)]
    rows = [(way, line) for way, line in ways if line is not None]
    with chart(page.picture("ladder"), 7, 1 + 0.3 * len(rows)) as figure:
        axes = figure.subplots()
        for place, (way, line) in enumerate(rows):
            colour = "C1" if way == OWN else "C0"
            low, middle, high = (max(-0.5, line[f"sealed{end}"]) for end in ("_low", "", "_high"))
            axes.plot([low, high], [place, place], color=colour, linewidth=1)
            axes.plot(middle, place, "o", color=colour, markersize=5)
        axes.set_yticks(range(len(rows)), [f"{way} ({line['spent']})" for way, line in rows])
        axes.set(title="Between kinds, by way (gauge presses on the target)", xlim=(-0.55, 1.02))
        axes.set_xlabel("R2 on drawn indenters, with its 95 % interval; below -0.5 at the edge")
