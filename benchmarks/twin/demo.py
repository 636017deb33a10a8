"""Record a sensor with an unknown skin on the mock bench, identify its twin, and foretell forces.

    python -m benchmarks twin-demo

The skin differs from the row that the fit begins with, in all that is fitted. It is pressed by a
sphere and a prism, and for comparison by a torus, whose presses the fit does not get.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

from recorder import Session
from recorder.command_line.errors import EXIT_DEVICE_LOST
from recorder.progress import Progress
from sim.errors import SceneError
from sim.sensors import read_sensor, sensor
from sim.sensors.quantities import quantities
from sim.twin import Fit, PressTrack, TrackModel, fitted, misfit, tracks_of
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
hold_ms: 1800                       # three relaxation times
camera: null                        # forces are enough for mechanics
trajectory:
  points: [1]
  depth_step_mm: 0.4
  depth_max_mm: 1.2
  angle_step_deg: 180.0
simulated: {sensor: SKIN, behind_ms: 2000, rate_hz: 40, grid: 64}
preflight: {timeout: 20}
limits: {stale_force_ms: 1500, stale_pose_ms: 1500}
"""
PRESSED, HELD_OUT = ("sphere", "prism"), "torus"
# Times that a recording is tried: a busy machine may keep an emulator from answering.
TRIES = 3


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the demonstration."""
    parser.add_argument(
        "--out", type=Path, default=Path("runs/twin-demo"), help="folder (%(default)s)"
    )


def run(options: argparse.Namespace) -> int:
    """Record what is not recorded yet, fit, compare with the truth, and return the exit code."""
    folder: Path = options.out
    folder.mkdir(parents=True, exist_ok=True)
    skin, bench = folder / "skin.yaml", folder / "bench.yaml"
    skin.write_text(SKIN, encoding="utf-8")
    bench.write_text(BENCH.replace("SKIN", str(skin.resolve())), encoding="utf-8")
    found = {name: recording(bench, folder, name) for name in (*PRESSED, HELD_OUT)}
    tracks = [track for name in PRESSED for track in tracks_of(Session(found[name]))]
    with Progress("twin", sys.stderr) as progress:
        fit = fitted(tracks, sensor("gelsight"), grid=64, processes=2, progress=progress)
    print("\n".join(lines(fit)))
    (folder / "twin.yaml").write_text(
        twin_yaml(fit.sensor, "gelsight.yaml", [found[name].name for name in PRESSED]),
        encoding="utf-8",
    )
    draw(fit, folder / "twin.png", f"Twin of a mock sensor: misfit {100 * fit.misfit:.2f} %")
    print(summary(fit, tracks_of(Session(found[HELD_OUT])), skin))
    return 0


def recording(bench: Path, folder: Path, indenter: str) -> Path:
    """Return the session of one indenter, recorded on the mock bench if it is not there yet.

    Raises:
        SceneError: The mock bench did not finish.
    """
    path = folder / f"{indenter}.zarr"
    for attempt in range(TRIES):
        if path.exists() and Session(path).status == "complete":
            return path
        path = path if not path.exists() else folder / f"{indenter}-{attempt}.zarr"
        print(f"recording {indenter} on the mock bench ...", file=sys.stderr, flush=True)
        words = ["collect", "--bench", str(bench), "--world", "sim", "--indenter", indenter]
        ended = subprocess.run(
            [sys.executable, "-m", "tactile", *words, "--out", str(path)],
            check=False,
            capture_output=True,
            text=True,
        )
        if ended.returncode not in (0, EXIT_DEVICE_LOST):
            break
    if path.exists() and Session(path).status == "complete":
        return path
    raise SceneError(f"{indenter}: not recorded: {ended.stderr.strip().splitlines()[-1:]}")


def summary(fit: Fit, held_out: list[PressTrack], skin: Path) -> str:
    """Return the errors of modulus, thickness, friction and forces on an unseen shape."""
    true = quantities(read_sensor(skin))
    errors = "".join(
        f"{name} {100 * abs(fit.values[name] / true[name] - 1):.1f} %  "
        for name in ("modulus", "thickness", "friction")
    )
    readings = TrackModel(fit.design, held_out, grid=64).readings(fit.values)
    return f"{errors}held-out force {100 * misfit(held_out, readings):.1f} %"
