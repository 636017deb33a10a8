"""Questions on the terminal of a bench, and notices of how its arm will move.

Only what is typed after a question answers it.
"""

from __future__ import annotations

import select
import sys
import termios

from rig.acquire.control import Interrupted
from rig.bench.bench import Bench
from rig.bench.indenter import find_indenter
from rig.core.config import from_si
from rig.core.errors import ConfigError
from trajectories import Plan


def require_terminal() -> None:
    """Reject a bench that will ask before it moves, if there is no terminal to ask on."""
    if not sys.stdin.isatty():
        raise ConfigError("lab bench: no terminal to ask on; allowed: a terminal at the bench")


def answer(question: str) -> str | None:
    """Return the line that is typed after the question has appeared, without its end.

    What was typed before is dropped: an Enter meant for an earlier command must not start an arm.

    Returns:
        The line; None at the end of input.
    """
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    print(question, end="", flush=True)
    # Ctrl-C may come as soon as the question appears; `input` misses one just before it reads.
    while not select.select([sys.stdin], [], [], 0.2)[0]:
        pass
    line = sys.stdin.readline()
    return line.removesuffix("\n") if line else None


def confirm(lines: list[str], word: str = "move") -> None:
    """Print what will happen, and wait until `word` is typed on this terminal."""
    print("\n".join(lines), flush=True)
    require_terminal()
    try:
        typed = answer(f'type "{word}" and Enter to start, anything else to stop: ')
    except KeyboardInterrupt:
        typed = None
    if typed != word:
        print()
        raise Interrupted(f'the answer was not "{word}"')


def motion_lines(bench: Bench, depth: float) -> list[str]:
    """Return the speeds, the box and the depth of a bench's motion as lines."""
    arm, limits = bench.arm, bench.limits

    def span(low: float, high: float) -> str:
        return f"{from_si(low, 'mm'):g} to {from_si(high, 'mm'):g} mm"

    forces = ", ".join(f"{limits.soft_fraction * force:.3g}" for force in bench.force_rating[:3])
    return [
        f"speed     {from_si(arm.speed, 'mm_s'):g} mm/s near the sensor, "
        f"{from_si(arm.travel_speed, 'mm_s'):g} mm/s above it",
        f"box       x {span(*limits.box_x)}, y {span(*limits.box_y)}, "
        f"z {span(-limits.depth_max, limits.height_max)} of the contact frame",
        f"depth     {from_si(depth, 'mm'):g} mm below the surface; a press ends at {forces} N",
        f"indenter  {find_indenter(bench.indenter).line()}",
    ]


def deepest(plan: Plan, total: int | None = None) -> float:
    """Return the deepest indentation of a plan's first `total` targets [m]; None: all."""
    most = len(plan) if total is None else total
    return max((target.depth for target in plan.targets() if target.index < most), default=0.0)
