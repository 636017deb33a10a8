"""`tactile jog`: move the arm with a SpaceMouse and set the contact frame's origin.

Only the tip's position changes, never the tool's orientation. The arm makes short straight moves
under the guard: inside the bench's box, never faster than the bench file allows, halted as soon as
the cap's direction changes or the cap is released or falls silent. If this process hangs, the arm
stops at the end of the current move, at most a second later.
"""

import argparse
import contextlib
import logging
import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from rig.acquire.control import InterruptFlag
from rig.acquire.setup_checks import origin_text
from rig.acquire.streams import Streams, check_devices, take_tares, tip_position
from rig.bench.bench import Bench
from rig.bench.guards import gauge_guards, guard_limits
from rig.cli.options import banner, bench_options, chosen_bench, confirm, motion_lines
from rig.cli.recording import started_bench
from rig.core.clock import SECOND_NS, SystemClock
from rig.core.config import from_si
from rig.core.errors import ConfigError, DeviceLost, SafetyStop
from rig.core.paced_line import PacedLine
from rig.devices.arm.arm import Arm, MoveResult
from rig.devices.hid.drivers import Cap, SpaceMouseDriver
from rig.devices.hid.reports import Axes
from trajectories import Point

logger = logging.getLogger(__name__)

# Duration of a move at the speed set by the cap [s].
REACH = 1.0
# Number of the button that sets the origin.
TAKE = 0

# Change of the cap's deflection, relative to full deflection, that ends the move.
_CHANGED = 0.15
# Shortest move [m]; the arm takes a shorter one as already completed.
_SHORTEST = 2e-4


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser, mock=False)


def run(options: argparse.Namespace) -> int:
    """Follow the SpaceMouse until its first button sets the origin; return the exit code."""
    file = chosen_bench(options)
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
    """Move the arm until an origin is set; return its text."""
    config = bench.jog
    if config is None:
        raise ConfigError("jog: missing")
    clock = SystemClock()
    interrupt = stack.enter_context(InterruptFlag())
    mouse = SpaceMouseDriver(config, clock)
    stack.callback(mouse.close)
    mouse.open()
    streams = stack.enter_context(Streams(bench, folder, clock, watch))
    check_devices(streams)
    arm = Arm(
        bench.arm,
        bench.contact_frame,
        guard_limits(bench),
        pose_path=folder / "pose.latest",
        guards=gauge_guards(bench, folder),
    )
    arm.start(bench.preflight.timeout)
    stack.callback(arm.close)
    for name, tare in take_tares(streams).items():
        streams[name].set_bias(tare["mean"])
    print(
        f"x, y, z of the cap move the tip at up to {1e3 * config.speed_max:g} mm/s; the first "
        "button takes the origin; Ctrl-C ends",
        flush=True,
    )
    jog = Jog(streams, arm, mouse, interrupt.check, speed_max=config.speed_max)
    try:
        tip = jog.run()
    except SafetyStop:
        retract(arm)
        raise
    text = origin_text(bench, tip)
    if not retract(arm):
        text += "\nTHE ARM WAS NOT RETRACTED"
    return text


def planned(
    shift: Axes, tip: Point, box: tuple[Point, Point], speed_max: float
) -> tuple[Point, float] | None:
    """Return the next goal [m] and speed [m/s] of the tip for a cap position; None: it stays.

    The cap is deflected by `shift`, -1 to 1 in x, y, z of the contact frame; at full deflection in
    any direction the tip at `tip` moves at `speed_max` [m/s], within the corners of `box` [m].
    """
    velocity = np.array(shift, np.float64)
    length = float(np.linalg.norm(velocity))
    if not length > 0:
        return None
    velocity *= speed_max / max(length, 1.0)
    here = np.array(tip)
    goal = np.clip(here + velocity * REACH, *np.array(box))
    if float(np.linalg.norm(goal - here)) < _SHORTEST:
        return None
    x, y, z = goal.tolist()
    return (x, y, z), float(np.linalg.norm(velocity))


class _CapChanged(Exception):
    """The cap's deflection no longer matches the current move."""


class Jog:
    """Moves the arm as the SpaceMouse directs.

    The arm is started, the mouse open, the F/T sensor of `streams` tared. `check` raises if the
    operator requested the end.
    """

    def __init__(
        self,
        streams: Streams,
        arm: Arm,
        mouse: SpaceMouseDriver,
        check: Callable[[], None],
        *,
        speed_max: float,
    ) -> None:
        self._streams = streams
        self._bench = streams.bench
        self._arm = arm
        self._mouse = mouse
        self._check_operator = check
        self._speed_max = speed_max
        elsewhere = partial(print, flush=True)
        self._line = PacedLine(sys.stdout, SECOND_NS // 5, 5 * SECOND_NS, elsewhere)
        self._pressed: frozenset[int] = frozenset()
        self._loaded = False

    def run(self) -> Point:
        """Follow the cap until a button sets the origin; return the tip, contact frame [m]."""
        box = guard_limits(self._bench).box
        while True:
            cap = self._look(0.02)
            if TAKE in self._pressed:
                self._line.end()
                return tip_position(self._streams)
            self._pressed = frozenset()
            self._arm.check()
            step = planned(cap.shift, tip_position(self._streams), box, self._speed_max)
            if step is not None:
                self._go(*step, cap)

    def _go(self, goal: Point, speed: float, cap: Cap) -> None:
        rising = cap.shift[2] > 0 and not any(cap.shift[:2])
        if self._loaded and not rising:
            return
        pose = self._bench.tool_pose(goal)
        try:
            result = self._arm.move(
                pose,
                speed=speed,
                acceleration=self._bench.arm.acceleration,
                # The arm must be able to leave a loaded surface, even beyond the soft limit.
                mode="retreat" if self._loaded else "guarded",
                on_wait=lambda: self._follow(cap),
            )
        except _CapChanged:
            self._arm.halt()
        except BaseException:
            self._arm.halt()
            raise
        else:
            self._check(result)

    def _check(self, result: MoveResult) -> None:
        if result.outcome == "stopped":
            raise DeviceLost(f"arm: {result.reason}")
        if result.outcome == "force_limited":
            self._line.end()
            logger.warning("%s: only straight up from here", result.reason)
        self._loaded = result.outcome == "force_limited"

    def _follow(self, begun: Cap) -> None:
        """Interrupt the move if the cap's deflection has changed since it began."""
        cap = self._look(0.0)
        worst = max(abs(a - b) for a, b in zip(cap.shift, begun.shift, strict=True))
        if worst > _CHANGED or not any(cap.shift) or self._pressed:
            raise _CapChanged

    def _look(self, timeout: float) -> Cap:
        self._check_operator()
        self._streams.check()
        cap = self._mouse.read(timeout)
        self._pressed |= cap.pressed
        self._show()
        return cap

    def _show(self) -> None:
        if self._line.is_due(self._streams.clock.now_ns()):
            x, y, z = (from_si(value, "mm") for value in tip_position(self._streams))
            tip = f"tip x {x:+8.3f}  y {y:+8.3f}  z {z:+8.3f} mm"
            self._line.show(tip, self._streams.pressing())


def retract(arm: Arm) -> bool:
    """Retract after an origin was set or a limit reached; return False if the arm cannot."""
    try:
        return arm.retract()
    except (SafetyStop, DeviceLost) as error:
        logger.warning("no retract: %s", error)
        return False
