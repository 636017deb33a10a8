"""Files of a twin: its row as YAML, and a picture of the forces beside the twin's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from recorder.charts import BAND, FORCES, INK, RED, SOFT, chart
from recorder.settings import yaml_text
from sim.arrays import Array
from sim.markers import HEIGHT, WIDTH
from sim.sensors import CameraSignal, SimulatedSensor
from sim.sensors.posterior import is_log
from sim.twin.camera import CameraFit, HeldOut, differences
from sim.twin.fit import Fit, Z, misfit
from sim.twin.gaugeless import OF_SENSOR, GaugelessFit, MarkedPress
from sim.twin.markers import MarkerObservations
from sim.twin.observations import PressTrack
from sim.twin.plan import PlannedPresses, Planner, cost

if TYPE_CHECKING:
    from recorder.charts import Axes

# Quantities as people write them: factor from SI, and unit.
SHOWN = {
    "modulus": (1e-3, "kPa"),
    "thickness": (1e3, "mm"),
    "time": (1.0, "s"),
    "height": (1e6, "um"),
    "compliance": (1e6, "um/N"),
    "turn": (180 / math.pi, "deg"),
    "tilt": (180 / math.pi, "deg"),
    "scale": (1e3, "mm/px"),
    "distance": (1e3, "mm"),
    "shift": (1.0, "px"),
    "rotation": (180 / math.pi, "deg"),
    "camera": (180 / math.pi, "deg"),
}
# Correlations from this on are listed.
STRONG = 0.7
# Most tracks that are drawn, and room for a legend above an image [px].
DRAWN, LEGEND = 4, 60


def skin_row(sensor: SimulatedSensor) -> dict[str, Any]:
    """Return the keys of a row that describe a skin with friction and viscosity."""
    body, effects = sensor.body, sensor.effects
    assert effects.viscosity is not None
    assert effects.friction is not None
    return {
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
    }


def twin_yaml(sensor: SimulatedSensor, design: str, sessions: Sequence[str]) -> str:
    """Return the row of a twin, which extends the design's file or row `design`."""
    posterior = sensor.posterior
    assert posterior is not None
    content: dict[str, Any] = {
        "extends": design,
        "description": f"Twin of a sensor, identified from {', '.join(sessions)}",
        **skin_row(sensor),
        "posterior": {
            "names": list(posterior.names),
            "spreads": [_round(spread) for spread in posterior.spreads],
            "correlations": [[round(each, 4) for each in row] for row in posterior.correlations],
            **({"tier": posterior.tier} if posterior.tier != "layer" else {}),
            "height_um": round(1e6 * posterior.height, 2),
            "law": round(posterior.law, 4),
        },
    }
    signal = sensor.signal
    if isinstance(signal, CameraSignal) and (signal.layout or "scale" in posterior.names):
        content["signal"] = _signal(signal)
    if sensor.trajectory is None:
        content["trajectory"] = None
    if sensor.force_depth is None:
        content["force_depth"] = None
    return yaml_text(content)


def _signal(signal: CameraSignal) -> dict[str, Any]:
    """Return the camera of a row as it is written, and its layout if it has one."""
    camera, layout, drawn = signal.camera(), signal.layout, {}
    if layout is not None:
        places = [[round(1e3 * each, 4) for each in centre] for centre in layout.places]
        shape = {"name": layout.name, "shape": layout.shape, "size_mm": _round(1e3 * layout.size)}
        turned = {"angle_deg": _round(math.degrees(layout.angle)), "places_mm": places}
        drawn = {"patterns": [layout.name], "layout": shape | turned}
    return {
        **drawn,
        "scale_mm_per_px": _round(camera.mm_per_px),
        "distance_mm": _round(1e3 * camera.distance),
        "shift_px": [_round(each) for each in camera.shift],
        "rotation_deg": _round(math.degrees(camera.rotation)),
        "tilt_deg": [_round(math.degrees(each)) for each in camera.tilt],
    }


def _line(name: str, value: float, interval: tuple[float, float], note: str) -> str:
    factor, unit = SHOWN.get(name.partition("_")[0], (1.0, ""))
    span = " to ".join(f"{factor * end:.4g}" for end in interval)
    return f"{name:<12}{factor * value:>10.4g}  {span:<15} {unit:<5}{note}"


def lines(
    fit: Fit, camera_fit: CameraFit | None = None, held_out: HeldOut | None = None
) -> list[str]:
    """Return the fitted values with 90 % intervals, strong correlations, and errors of the fit."""
    report = [f"{'quantity':<12}{'value':>10}  {'90 % interval':<22}"]
    for name in fit.names:
        note = "  not told by these presses, the prior's" if name in fit.unidentified else ""
        if name == "friction" and note:
            note = f"  at least {least_friction(fit.tracks):.2f}: it hardly slipped"
        report.append(_line(name, fit.values[name], fit.interval(name), note))
    if camera_fit is not None:
        for name, value in camera_fit.values.items():
            note = (
                "  not told by these images, the row's" if name in camera_fit.unidentified else ""
            )
            report.append(_line(name, value, camera_fit.interval(name), note))
    spread = np.sqrt(np.diag(fit.covariance))
    matrix = fit.covariance / np.outer(spread, spread)
    pairs = [
        f"{fit.names[a]} and {fit.names[b]} {matrix[a, b]:+.2f}"
        for a in range(len(matrix))
        for b in range(a)
        if abs(matrix[a, b]) >= STRONG
    ]
    report.append(f"correlations above {STRONG:g}: {', '.join(pairs) or 'none'}")
    report.append(
        f"misfit {100 * fit.misfit:.2f} % of the forces at rest; error of the law "
        f"{100 * fit.law:.2f} %; moving forces are {1e3 * fit.latency:.0f} ms late, timing "
        f"{1e3 * fit.timing:.0f} ms"
    )
    if camera_fit is not None:
        layout = camera_fit.signal.drawn()[0]
        report.append(
            f"{_marker_line(camera_fit.observations, camera_fit.predicted)}; layout: "
            f"{len(layout)} markers ({layout.shape}, {1e3 * layout.size:.3g} mm), "
            f"image without contact overlaps {100 * camera_fit.overlap:.0f} %"
        )
        if camera_fit.either_way:
            report.append("mirrored images would fit as well: shear in two directions tells")
    if held_out is not None:
        off = misfit(held_out.tracks, held_out.readings)
        line = f"held out: misfit {100 * off:.2f} % of the forces at rest"
        if held_out.predicted:
            line += f"; {_marker_line(held_out.observations, held_out.predicted)}"
        report.append(line)
    return report


def lines_without_gauge(
    fit: GaugelessFit, foretold: Sequence[tuple[MarkedPress, float, float]]
) -> list[str]:
    """Return fitted values with 90 % intervals, errors, and weights that were not fitted.

    Of each weight there is its press, the twin's force [N] and the spread of its logarithm.
    """
    report = [f"{'quantity':<12}{'value':>10}  {'90 % interval':<22}"]
    for name in (*OF_SENSOR, "compliance"):
        note = "  not told by these presses, the prior's" if name in fit.unidentified else ""
        if name == "modulus" and not fit.weighed:
            note = "  no weight (--weight): the prior's, and so is the scale of all forces"
        report.append(_line(name, fit.values[name], fit.interval(name), note))
    report.append("relaxation is the design's: markers do not tell it")
    report.append(
        f"{len(fit.presses)} presses; {_marker_line(fit.presses, fit.predicted)}; noise "
        f"{fit.noise[0]:.2f} px, error of the model {100 * fit.noise[1]:.1f} % of the motion"
    )
    for press, force, spread in foretold:
        low, high = (force * math.exp(sign * Z * spread) for sign in (-1, 1))
        outside = "" if low <= press.weight <= high else ": OUTSIDE, do not trust its forces"
        report.append(
            f"{press.name}, not fitted: {press.weight:.3f} N; by the twin {force:.3f} N, 90 % "
            f"interval {low:.3f} to {high:.3f} N{outside}"
        )
    return report


def _marker_line(
    observations: Sequence[MarkerObservations | MarkedPress], places: Sequence[Array]
) -> str:
    off, way = differences(observations, places)
    return f"markers differ by {off:.2f} px of {way:.2f} px ({100 * off / way:.1f} %)"


def plan_files(planned: Sequence[PlannedPresses], bench: str) -> dict[str, str]:
    """Return the text of each file of a plan: a bench for each session, and `campaign.yaml`.

    `bench` is the bench file that presses, relative to the plan's folder.
    """
    files, entries = {}, []
    for number, each in enumerate(planned, 1):
        name = f"twin-{number}"
        plan = each.plan
        trajectory = {
            "kind": plan.KIND,
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
    planner: Planner,
    planned: Sequence[PlannedPresses],
    usual: Sequence[PlannedPresses],
    change: float,
) -> list[str]:
    """Return the sessions of a plan, and the 90 % intervals to expect with and without it."""
    report = [session_line(each) for each in planned]
    columns = {"plan": planned, "sphere, prism": usual}
    report.append(f"{'90 % interval, +-':<20}" + "".join(f"{name:>16}" for name in columns))
    spreads = [planner.expected(each).spreads for each in columns.values()]
    for name in planner.names:
        factor, unit = SHOWN.get(name.partition("_")[0], (1.0, ""))
        factor, unit = (100.0, "%") if is_log(name) else (factor, unit)
        report.append(
            f"{f'{name} [{unit}]' if unit else name:<20}"
            + "".join(f"{1.645 * factor * each[name]:>16.3g}" for each in spreads)
        )
    for label, count in (
        ("presses", lambda part: sum(len(each.plan) for each in part)),
        ("seconds", lambda part: round(sum(each.seconds for each in part))),
        ("with changes", lambda part: round(cost(part, change))),
    ):
        report.append(f"{label:<20}" + "".join(f"{count(each):>16}" for each in columns.values()))
    return report


def session_line(each: PlannedPresses) -> str:
    """Return the presses of a session in words."""
    depths = " and ".join(f"{1e3 * depth:.3g}" for depth in each.depths)
    shear = f"shear {1e3 * each.plan.shear:.3g} mm"
    return f"{each.indenter}: depth {depths} mm, {shear}, hold {each.hold:.2g} s"


def least_friction(tracks: Sequence[PressTrack]) -> float:
    """Return the largest shear over normal force at rest: friction is at least that."""
    most = 0.0
    for track in tracks:
        normal, shear = -track.force[:, 2], np.hypot(track.force[:, 0], track.force[:, 1])
        sure = track.rest & track.contact & (normal > 0.3 * normal.max(initial=0.0))
        most = max(most, float((shear[sure] / normal[sure]).max(initial=0.0)))
    return most


def values_of(fit: Fit | GaugelessFit) -> dict[str, Any]:
    """Return what a fit finds as plain values in SI, for programs."""
    return {
        "values": {name: fit.values[name] for name in fit.names},
        "intervals_90": {name: list(fit.interval(name)) for name in fit.names},
        "spreads": fit.spreads,
        "logarithmic": [name for name in fit.names if is_log(name)],
        "untold": list(fit.unidentified),
        "rounds": fit.rounds,
    }


def summary(
    fit: Fit, camera_fit: CameraFit | None = None, held_out: HeldOut | None = None
) -> dict[str, Any]:
    """Return the result as plain values in SI, pixels in px, for programs."""
    content = values_of(fit) | {
        "misfit": fit.misfit,
        "law": fit.law,
        "timing": fit.timing,
        "latency": fit.latency,
    }
    if camera_fit is not None:
        off, way = differences(camera_fit.observations, camera_fit.predicted)
        content["view"] = {
            "values": camera_fit.values,
            "intervals_90": {name: list(camera_fit.interval(name)) for name in camera_fit.values},
            "untold": list(camera_fit.unidentified),
            "markers": len(camera_fit.signal.drawn()[0]),
            "overlap": camera_fit.overlap,
            "mirrored_as_well": camera_fit.either_way,
            "off_px": off,
            "moved_px": way,
        }
    if held_out is not None:
        content["held_out"] = {"misfit": misfit(held_out.tracks, held_out.readings)}
        if held_out.predicted:
            content["held_out"]["off_px"] = differences(held_out.observations, held_out.predicted)[
                0
            ]
    return content


def draw(
    fit: Fit,
    path: Path,
    title: str,
    camera_fit: CameraFit | None = None,
    held_out: HeldOut | None = None,
) -> None:
    """Draw forces and markers of tracks beside the twin's, and differences, as a picture."""
    drawn = [(each, read, "") for each, read in zip(fit.tracks, fit.readings, strict=True)][:DRAWN]
    pictures = [] if camera_fit is None else [(camera_fit.observations, camera_fit.predicted, "")]
    if held_out is not None:
        pairs = zip(held_out.tracks, held_out.readings, strict=True)
        drawn += [(each, read, ", held out") for each, read in pairs][:DRAWN]
        pictures += [(held_out.observations, held_out.predicted, ", held out")]
    pictures = [each for each in pictures if each[1]]
    count = len(drawn) + bool(pictures)
    heights = [1.0] * len(drawn) + [1.9] * bool(pictures)
    with chart(path, 11.0, 2.6 * sum(heights) + 0.8) as figure:
        grid = figure.add_gridspec(count, 1, height_ratios=heights)
        for column, (observations, predicted, kind) in enumerate(pictures):
            within = grid[-1].subgridspec(1, 2)
            _draw_markers(figure.add_subplot(within[column]), observations, predicted, kind)
        axes = np.array(
            [
                grid[row].subgridspec(1, 2, width_ratios=(2, 1)).subplots()
                for row in range(len(drawn))
            ]
        )
        for (left, right), (track, reading, kind) in zip(axes, drawn, strict=True):
            used = track.contact
            order = np.arange(int(used.sum()))
            force, read = track.force[used], reading[used]
            for axis, colour in enumerate(FORCES):
                left.plot(order, force[:, axis], ".", color=colour, markersize=3)
                left.plot(order, read[:, axis], "-", color=colour, label=f"F{'xyz'[axis]}")
            left.set_title(
                f"{track.name}, {track.indenter}{kind}: measured (dots) and twin (lines)"
            )
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


def _draw_markers(
    axes: Axes, observations: Sequence[MarkerObservations], predicted: Sequence[Array], kind: str
) -> None:
    """Draw the markers at the point of some observations where they have moved farthest."""
    ways = [
        np.nanmean(np.square(s.observed - s.undeformed[None]), axis=(1, 2)) for s in observations
    ]
    best = max(range(len(observations)), key=lambda each: float(ways[each].max()))
    widest, point = observations[best], int(ways[best].argmax())
    observed, markers = widest.observed[point], predicted[best][point]
    for (x, y), (column, row) in zip(widest.undeformed, observed, strict=True):
        axes.plot([x, column], [y, row], "-", color=BAND, linewidth=1.0)
    axes.plot(*widest.undeformed.T, ".", color=SOFT, markersize=3, label="without contact")
    axes.plot(*observed.T, "o", color=INK, fillstyle="none", markersize=6, label="seen")
    axes.plot(*markers.T, "x", color=RED, markersize=5, label="twin")
    axes.set(xlim=(0, WIDTH), ylim=(HEIGHT, -LEGEND), aspect="equal", ylabel="row [px]")
    off = math.sqrt(np.nanmean(np.square(observed - markers).sum(axis=1)))
    axes.set_title(f"{widest.track.name}, {widest.track.indenter}{kind}: {off:.2f} px")
    axes.set_xlabel("column [px]")
    axes.legend(loc="upper right", ncols=3)


def _round(value: float) -> float:
    return float(f"{value:.6g}")
