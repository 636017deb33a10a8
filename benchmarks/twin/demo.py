"""Record a sensor with an unknown skin on the mock bench, identify its twin, and predict forces.

The skin differs from the row that the fit begins with, in all that is fitted. It is pressed by a
sphere and a prism, and for comparison by a torus, whose presses the fit does not get.
"""

import subprocess
import sys
from pathlib import Path
from typing import Any

from benchmarks.first_hour import TRIES
from benchmarks.report import Page, Run, table
from benchmarks.twin.planted import GAUGE
from recorder import Session
from recorder.charts import BLUE, ORANGE, SOFT, chart
from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from sim.errors import SceneError
from sim.sensors import read_sensor, sensor
from sim.sensors.quantities import quantities
from sim.twin import TrackModel, fitted, misfit, tracks_of
from sim.twin.record import draw, lines, twin_yaml

# The unknown skin, and the bench that presses it.
SKIN = """\
extends: gelsight.yaml
description: GelSight of a thinner, stiffer, smoother and slower silicone
body: {thickness_mm: 3.5, modulus_kpa: 190.0, poisson: 0.46}
effects:
  friction: {coefficient: 0.62}
  viscosity: {ratios: [0.12, 0.22], times_s: [0.06, 0.6], relaxes: all}
"""
BENCH = """\
extends: gelsight.yaml
hold_ms: HOLD                       # three relaxation times
camera: null                        # forces are enough for mechanics
trajectory:
  points: [1]
  depth_step_mm: STEP
  depth_max_mm: 1.2
  angle_step_deg: 180.0
world: {sensor: SKIN, solver: {behind_ms: 2000, rate_hz: 40, grid: 64}}
preflight: {timeout: 20}
limits: {stale_force_ms: 1500, stale_pose_ms: 1500}
"""
HELD_OUT = "torus"
UNITS = {"modulus": " [Pa]", "thickness": " [m]", "time": " [s]"}


def measure(run: Run) -> dict[str, Any]:
    """Record, fit, and compare with the truth; alone, sessions stay beside the page."""
    alone = run.options.only == ["demo"] and run.options.out is not None
    folder: Path = run.options.out.parent if alone else run.folder
    folder.mkdir(parents=True, exist_ok=True)
    skin, bench = folder / "skin.yaml", folder / "bench.yaml"
    skin.write_text(SKIN, encoding="utf-8")
    text = BENCH.replace("SKIN", str(skin.resolve()))
    hold, step, pressed = ("300", "1.2", GAUGE[:1]) if run.quick else ("1800", "0.4", GAUGE)
    bench.write_text(text.replace("HOLD", hold).replace("STEP", step), encoding="utf-8")
    tracks, held_out = {}, pressed[0] if run.quick else HELD_OUT
    for name in dict.fromkeys((*pressed, held_out)):
        tracks[name] = tracks_of(recorded(bench, folder / f"{name}.zarr", name))
        run.progress(0.25 * len(tracks))
    grid, processes = (32, 1) if run.quick else (64, 2)
    fit = fitted(
        [track for name in pressed for track in tracks[name]],
        sensor("gelsight"),
        grid=grid,
        processes=processes,
    )
    text = twin_yaml(fit.sensor, "gelsight.yaml", [f"{name}.zarr" for name in pressed])
    (folder / "twin.yaml").write_text(text, encoding="utf-8")
    draw(fit, folder / "twin.png", f"Twin of a mock sensor: misfit {100 * fit.misfit:.2f} %")
    true, unseen = quantities(read_sensor(skin)), tracks[held_out]
    readings = TrackModel(fit.design, unseen, grid=grid).readings(fit.values)
    run.spread = "one session"
    values = {
        "rows": [
            {"name": name, "truth": value, "twin": fit.values[name], "interval": fit.interval(name)}
            for name, value in true.items()
        ],
        "misfit": fit.misfit,
        "held_out": misfit(unseen, readings),
    }
    print("\n".join([*lines(fit), last_line(values)]))
    return values


def recorded(bench: Path, path: Path, indenter: str) -> Session:
    """Return an indenter's session, recorded if not there yet; SceneError if the bench fails."""
    for _ in range(TRIES):
        words = ["--bench", str(bench), "--world", "sim", "--indenter", indenter]
        words += ["--out", str(path)]
        if path.exists():
            if Session(path).status == "complete":
                break
            words = ["--resume", str(path)]
        ended = subprocess.run(
            [sys.executable, "-m", "tactile", "collect", *words],
            check=False,
            capture_output=True,
            text=True,
        )
        if ended.returncode not in (EXIT_DONE, EXIT_DEVICE_LOST):
            raise SceneError(f"{indenter}: not recorded: {ended.stderr.strip()[-200:]}")
    return Session(path)


def last_line(values: dict[str, Any]) -> str:
    """Return the errors of modulus, thickness, friction and forces on an unseen shape."""
    rows = {row["name"]: row for row in values["rows"]}
    errors = "".join(
        f"{name} {100 * abs(rows[name]['twin'] / rows[name]['truth'] - 1):.1f} %  "
        for name in ("modulus", "thickness", "friction")
    )
    return f"{errors}held-out force {100 * values['held_out']:.1f} %"


def section(values: dict[str, Any], page: Page) -> str:
    """Return the twin beside the truth, and draw both."""
    rows = values["rows"]
    body = []
    for row in rows:
        unit = UNITS.get(row["name"].partition("_")[0], "")
        values_of = [f"{row[key]:.4g}" for key in ("truth", "twin")]
        low, high = row["interval"]
        body.append([f"{row['name']}{unit}", *values_of, f"{low:.4g} to {high:.4g}"])
    with chart(page.picture("demo"), 7.0, 2.8) as figure:
        axes = figure.subplots()
        for place, row in enumerate(rows):
            low, high = (100 * (each / row["truth"] - 1) for each in row["interval"])
            axes.plot([low, high], [place, place], color=SOFT, lw=3)
            axes.plot(100 * (row["twin"] / row["truth"] - 1), place, "o", color=BLUE)
        axes.axvline(0, color=ORANGE, lw=1)
        axes.set_yticks(range(len(rows)), [row["name"] for row in rows])
        axes.invert_yaxis()
        axes.set_xlabel("difference from the truth (orange) [%]; grey: 90 % interval")
    return f"""## A mock session and its twin
`make demo-twin` records a sensor whose skin differs from its row in all that is fitted, in real
time on the mock bench, with noise of 10 mN and forces that lag behind the arm; sphere and prism,
two directions, three depths, held three relaxation times. A ratio is the stiffness of a relaxing
branch over that at rest, and the time is its own.

{table(["quantity", "truth", "twin", "90 % interval"], body)}

{page.link("demo", "The twin's quantities and intervals beside the truth")}

Forces at rest differ by {100 * values["misfit"]:.2g} %, and by {100 * values["held_out"]:.2g} %
under a `{HELD_OUT}` that the fit did not get. The grid of the mock and of the fit is the same: no
error of pixels is in this session.
"""
