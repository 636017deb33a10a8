"""`tactile sim press`: press to a sequence of depths, hold or shear there, and show the result."""

import argparse
import json
import math
import os
import sys
import time
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.command_line import terminal
from recorder.progress import Progress
from sim.arrays import Array
from sim.cli.options import add_scene_options, scene_of, split_shape, tier_of
from sim.error_estimate import notes
from sim.errors import SceneError, SimulationDiverged
from sim.layer import Layer
from sim.result import ContactTier, Quality, Result
from sim.scene import Scene
from sim.tiers import simulate


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    add_scene_options(parser)


def run(options: argparse.Namespace) -> int:
    """Press, show and save every frame with contact and return the exit code.

    Without a solution up to the end, the part that was reached is shown before the error.
    """
    began = time.perf_counter()
    scene = scene_of(options)
    if options.effects:
        return _show_effects(scene, options)
    picture = _picture_path(options)
    _make_room(options.save, picture)
    try:
        result = _simulated(scene, options)
    except SimulationDiverged as diverged:
        if diverged.reached is not None:
            _show(diverged.reached, options, picture, time.perf_counter() - began)
        raise
    _show(result, options, picture, time.perf_counter() - began)
    return 0


def _show(
    result: Result, options: argparse.Namespace, picture: Path | None, seconds: float
) -> None:
    """Print a result and save the parts asked for."""
    if options.save is not None:
        from sim.store import save_results

        save_results(options.save, [result])
    if picture is not None:
        from sim.plot import save_picture

        save_picture(result, picture)
    if options.json:
        print(json.dumps(as_json(result, seconds=seconds), allow_nan=False))
        return
    lines = [heading(result), "", *table(result), "", stages(result, seconds)]
    lines += [f"note: {note}" for note in notes(result)]
    lines += [str(path) for path in (options.save, picture) if path is not None]
    print("\n".join(lines))


def _show_effects(scene: Scene, options: argparse.Namespace) -> int:
    """Print the changes by each effect and return the exit code."""
    for name in ("out", "save", "tolerance", "seconds", "tier"):
        if (value := getattr(options, name)) is not None:
            allowed = "without, it only prints a table by a coarse mesh"
            raise SceneError(f"--{name}: {value} with --effects; allowed: {allowed}")
    from sim.device import ready_device
    from sim.effect_sizes import effects_table

    kernels = ready_device(options.device)
    with Progress("press", sys.stderr, kernels=kernels) as progress:
        effects = effects_table(scene, device=options.device, progress=progress)
    print(json.dumps(effects.record(), allow_nan=False) if options.json else effects)
    return 0


def _simulated(scene: Scene, options: argparse.Namespace) -> Result:
    tier = tier_of(options)
    only: ContactTier | None = None
    if options.tier is not None:
        only = "layer" if isinstance(tier, Layer) else "fem"
    kernels = None
    if not isinstance(tier, Layer):
        from sim.device import ready_device

        kernels = ready_device(options.device)
    with Progress("press", sys.stderr, kernels=kernels) as progress:
        if options.tolerance is None:
            return simulate(scene, tier, device=options.device, progress=progress)
        from sim.planning import plan

        within = plan(
            scene, options.tolerance, seconds=options.seconds, only=only, device=options.device
        )
        return within.run(progress=progress)


def _picture_path(options: argparse.Namespace) -> Path | None:
    path: Path | None = options.out
    if path is None:
        shape, _ = split_shape(options.shape)
        return None if options.json else Path(f"press-{Path(shape).stem}.png")
    if path.suffix.lower() != ".png":
        raise SceneError(f"--out: {path}; allowed: a name that ends in .png")
    return path


def _make_room(save: Path | None, picture: Path | None) -> None:
    """Check, before simulating, that the results can be written."""
    if save is not None and save.exists():
        raise SceneError(f"--save: {save} exists; allowed: a new path")
    for path in (save, picture):
        if path is None:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(f"{path.parent}: not writable")


# Results in millimetres and newtons, as one JSON object or as a table.


def as_json(result: Result, *, seconds: float) -> dict[str, Any]:
    """Return all frames but the first, which only touches, and the seconds, as JSON values."""
    scene, frames = result.scene, slice(1, None)
    tip = np.array(scene.motion.tip, float)[frames] * 1e3
    force, torque = result.wrench[frames, :3], result.wrench[frames, 3:]
    quality = {
        one.name: _plain(getattr(result.quality, one.name)[frames]) for one in fields(Quality)
    }
    return {
        "depth_mm": _plain(-tip[:, 2]),
        "force_n": _plain(-force[:, 2]),
        "seconds": round(seconds, 4),
        "time_s": _plain(np.array(scene.motion.time, float)[frames]),
        "tip_mm": _plain(tip),
        "wrench_n_nm": _plain(np.concatenate([force, torque], axis=1)),
        "indenter": {
            "name": scene.indenter.name,
            "edge_radius_mm": scene.indenter.edge_radius * 1e3,
            "tilt_deg": [math.degrees(angle) for angle in scene.indenter.tilt],
        },
        "tier": result.tier,
        "effects": list(scene.effects.key),
        "mesh": result.record["mesh"],
        "precision": result.record["precision"],
        "device": result.record["device"],
        "plan": result.record.get("plan"),
        "error": result.record.get("error"),
        "seconds_by_stage": result.record["seconds"],
        "quality": quality,
        "notes": notes(result),
    }


def table(result: Result) -> list[str]:
    """Return a table's lines, one row per frame but the first, without empty columns."""
    motion, quality, force = result.scene.motion, result.quality, result.force
    tip = np.array(motion.tip, float) * 1e3
    timed = {"viscosity", "inertia"} & set(result.scene.effects.key)
    sheared = np.abs(force[:, :2]).max(axis=0) > 1e-3 * np.abs(force).max()
    columns: list[tuple[str, str, Array, bool]] = [
        ("time [s]", ".4g", np.array(motion.time, float), bool(timed)),
        ("x [mm]", "z.3f", tip[:, 0], bool(tip[:, 0].any())),
        ("y [mm]", "z.3f", tip[:, 1], bool(tip[:, 1].any())),
        ("depth [mm]", "z.3f", -tip[:, 2], True),
        ("force [N]", "z.4f", -force[:, 2], True),
        ("Fx [N]", "z.4f", force[:, 0], bool(sheared[0])),
        ("Fy [N]", "z.4f", force[:, 1], bool(sheared[1])),
        ("residual", ".0e", quality.residual, True),
        ("contact", ".0e", quality.contact, True),
        ("balance", ".0e", quality.balance, True),
        ("energy gap", "z.4f", quality.energy_gap, True),
        ("det F min", "z.3f", quality.det_f_min, True),
        ("slip excess", ".0e", quality.slip_excess, True),
        ("newton", "z.0f", quality.newton.astype(float), True),
        ("cg", "z.0f", quality.cg.astype(float), bool(quality.cg.any())),
    ]
    return terminal.table(
        {
            heading: [format(value, form) for value in values[1:]]
            for heading, form, values, wanted in columns
            if wanted and np.isfinite(values).any()
        },
        spare=[heading for heading, *_ in reversed(columns[7:])],
        complete="--json",
    )


def heading(result: Result) -> str:
    """Return one line that describes the scene, the tier, the mesh and the device."""
    scene, body = result.scene, result.scene.body
    size = "x".join(f"{side * 1e3:g}" for side in (body.size_x, body.size_y, body.thickness))
    dome = f", dome {body.dome_radius * 1e3:g} mm" if body.dome_radius else ""
    outline = ", ellipse" if body.footprint == "ellipse" else ""
    edge = scene.indenter.edge_radius
    edges = f", edges {edge * 1e3:g} mm" if edge else ""
    cells = result.record["mesh"].get("cells") or result.record["mesh"]["grid"]
    mesh = "x".join(str(count) for count in cells)
    effects = ", ".join(scene.effects.key) or "no effects"
    return (
        f"{scene.indenter.name}{edges}; body {size} mm{outline}{dome}, {body.modulus / 1e6:g} MPa, "
        f"nu {body.poisson:g}; {effects}; {result.tier} {mesh}, {result.record['precision']}, "
        f"{result.record['device']}"
    )


def stages(result: Result, seconds: float) -> str:
    """Return one line with the total time and the time of each stage."""
    parts = ", ".join(f"{name} {value:.2f}" for name, value in result.record["seconds"].items())
    return f"{seconds:.2f} s ({parts})"


def _plain(values: NDArray[Any]) -> Any:
    """Return lists of numbers, with None for non-finite ones, which JSON cannot represent."""
    # The sum makes -0.0 a 0.0.
    return np.where(np.isfinite(values), values + 0, np.array(None)).tolist()
