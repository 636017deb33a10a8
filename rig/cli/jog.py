"""`tactile jog`: move the arm with a SpaceMouse and set the contact frame's origin."""

from __future__ import annotations

import argparse
import contextlib
import logging
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from rig.bench.bench import BenchFile
from rig.bench.guards import gauge_guards
from rig.cli.options import banner, bench_options, chosen_bench
from rig.cli.recording import started_bench
from rig.cli.terminal import confirm, motion_lines
from rig.core.clock import SystemClock
from rig.core.errors import ConfigError, SafetyStop

if TYPE_CHECKING:
    from rig.bench.bench import Bench

logger = logging.getLogger(__name__)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser, mock=False)


def run(options: argparse.Namespace) -> int:
    """Follow the SpaceMouse until its first button sets the origin; return the exit code."""
    return follow(chosen_bench(options))


def follow(file: BenchFile) -> int:
    """Move a bench's arm as its SpaceMouse directs, print the origin; return the exit code."""
    bench = file.bench
    if bench.no_gauge:
        raise ConfigError(
            f"jog: {bench.sensor} has no F/T sensor that would stop the arm; allowed: the pendant"
        )
    if bench.jog is None:
        raise ConfigError(
            f"{file.path}.jog: missing; allowed: {{kind: spacemouse, device: 256f:c635}}"
        )
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    print(banner(file), flush=True)
    if not bench.mock:
        confirm(motion_lines(bench, bench.limits.depth_max))
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tactile-rig-")))
        on = stack.enter_context(started_bench(file, folder=folder))
        print(_jogged(on.file.bench, folder, on.watch, stack), flush=True)
    return 0


def _jogged(
    bench: Bench, folder: Path, watch: Callable[[], None] | None, stack: contextlib.ExitStack
) -> str:
    from rig.acquire.control import InterruptFlag
    from rig.acquire.jog import Jog, origin_text, retract
    from rig.acquire.streams import Streams, check_devices, take_tares
    from rig.devices.arm.arm import Arm
    from rig.devices.hid.spacemouse import SpaceMouseDriver

    if bench.jog is None:
        raise ConfigError("jog: missing")
    clock = SystemClock()
    interrupt = stack.enter_context(InterruptFlag())
    mouse = SpaceMouseDriver(bench.jog, clock)
    stack.callback(mouse.close)
    mouse.open()
    streams = stack.enter_context(Streams(bench, folder, clock, watch))
    check_devices(streams)
    arm = Arm(
        bench.arm,
        bench.contact_frame,
        bench.guard_limits(),
        pose_path=folder / "pose.latest",
        guards=gauge_guards(bench, folder),
    )
    arm.start(bench.preflight.timeout)
    stack.callback(arm.close)
    for name, tare in take_tares(streams).items():
        streams[name].set_bias(tare["mean"])
    print(
        f"x, y, z of the cap move the tip at up to {1e3 * bench.jog.speed_max:g} mm/s; the first "
        "button takes the origin; Ctrl-C ends",
        flush=True,
    )
    jog = Jog(streams, arm, mouse, interrupt.check, speed_max=bench.jog.speed_max)
    try:
        tip = jog.run()
    except SafetyStop:
        retract(arm)
        raise
    text = origin_text(bench, tip)
    if not retract(arm):
        text += "\nTHE ARM WAS NOT RETRACTED"
    return text
