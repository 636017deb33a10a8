"""What the verbs share: simulate the scene of the options, and hand its result over."""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from pathlib import Path

from sim.errors import SceneError
from sim.motion import Motion
from sim.progress import Progress
from sim.result import Result
from sim.scene import Scene
from sim.simulate import simulate
from sim.verbs.indenter_options import indenter_of
from sim.verbs.options import body_of, effects_of, numerics_of
from sim.verbs.summary import as_json, heading, notes, stages, table


def run_motion(options: argparse.Namespace, motion: Motion, *, first: int = 0) -> int:
    """Simulate `motion` with the rest of the options, show and keep the result; the exit code.

    `first` is the first frame that is told of.

    Raises:
        SceneError, SimulationDiverged: Before anything was written.
    """
    began = time.perf_counter()
    scene = Scene(
        indenter=indenter_of(options),
        motion=motion,
        body=body_of(options),
        effects=effects_of(options),
    )
    picture = _picture_path(options)
    _make_room(options.save, picture)
    result = _simulated(scene, options)
    seconds = time.perf_counter() - began
    if options.save is not None:
        from sim.store import save_results

        save_results(options.save, [result])
    if picture is not None:
        from sim.picture import save_picture

        save_picture(result, picture)
    if options.json:
        print(json.dumps(as_json(result, first=first, seconds=seconds), allow_nan=False))
        return 0
    print(heading(result))
    print()
    for line in table(result, first=first):
        print(line)
    print()
    print(stages(result, seconds))
    for note in notes(result):
        print(f"note: {note}")
    for path in (options.save, picture):
        if path is not None:
            print(path)
    return 0


def _simulated(scene: Scene, options: argparse.Namespace) -> Result:
    numerics = numerics_of(options)
    kernels = None
    if options.tier != "layer":
        from sim.verbs.device import ready_device

        kernels = ready_device(options.device)
    with Progress(options.verb, sys.stderr, kernels=kernels) as progress:
        return simulate(
            scene,
            options.tier,
            tolerance=options.tolerance,
            error_bar=options.error_bar,
            extrapolate=options.extrapolate,
            numerics=numerics,
            device=options.device,
            progress=progress,
        )


def _picture_path(options: argparse.Namespace) -> Path | None:
    """Where the picture goes; None when none is wanted."""
    path: Path | None = options.out
    if path is None:
        return None if options.json else Path(f"{options.verb}-{Path(options.shape).stem}.png")
    if path.suffix.lower() != ".png":
        raise SceneError(f"--out: {path}; allowed: a name that ends in .png")
    return path


def _make_room(save: Path | None, picture: Path | None) -> None:
    """Find out before the work whether its results can be written."""
    if save is not None and save.exists():
        raise SceneError(f"--save: {save} exists; allowed: a new path")
    for path in (save, picture):
        if path is None:
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        if not os.access(path.parent, os.W_OK):
            raise PermissionError(f"{path.parent}: not writable")
