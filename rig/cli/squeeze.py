"""`tactile collect` on a bench with a hand: squeeze objects between its two fingers."""

import argparse
import contextlib
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from rig.acquire.squeeze import Hands, collect_squeezes
from rig.bench.pair import PairFile
from rig.cli.options import answer, confirm, free_path, logged_to
from rig.core.clock import file_stamp
from rig.core.emulation import inject
from rig.core.errors import ConfigError
from rig.core.mock_names import PORTS

# Options of `collect` that a bench with a hand does not have.
_OTHERS = ("again", "indenter", "watch", "world", "force", "camera", "still", "taxels")


def run(options: argparse.Namespace, content: dict[str, Any], path: Path) -> int:
    """Collect a session of the hand in a bench file; return the exit code."""
    for name in _OTHERS:
        if getattr(options, name, None):
            raise ConfigError(f"--{name}: does not go with the fingers of {path}")
    if options.targets is not None and options.targets < 1:
        raise ConfigError(f"--targets: found {options.targets}; allowed: 1 or more")
    file = PairFile.of_sensors(content, path)
    bench = file.bench
    if options.truth and not bench.mock:
        raise ConfigError(f"--truth: {path} is a lab bench; allowed: a mock bench")
    print(f"{'MOCK' if bench.mock else 'LAB'} BENCH ({path}): two fingers, no arm", flush=True)
    session = options.out or free_path(Path("sessions") / f"{bench.sensor}-{file_stamp()}.zarr")
    if not bench.mock:
        gripper, deepest = bench.gripper, f"{1e3 * bench.squeeze.deepest:g} mm"
        lines = [
            f"fingers   close at speed {gripper.speed} and force {gripper.force} of 255, to at "
            f"most {deepest} less than an object's width",
            "objects   are held and taken by you; the fingers open only after you hold them",
        ]
        confirm(lines, "squeeze")
    session.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        stack.enter_context(logged_to(session))
        temporary = tempfile.TemporaryDirectory(prefix="tactile-rig-")
        folder, watch = Path(stack.enter_context(temporary)), None
        world: Hands | None = None
        if bench.mock:
            # Imported here, so that a collection on lab devices loads no emulator.
            from rig.mock.bench import MockHand

            mock = stack.enter_context(MockHand(file, folder, truth=options.truth))
            file, watch = mock.file, mock.check
            world = partial(inject, mock.hosts["left"], PORTS["world"])

        def hands(check: Callable[[], None]) -> Hands:
            return world or partial(_ask, [each.name for each in bench.objects], check)

        more = {"operator": options.operator, "most": options.targets, "watch": watch}
        return collect_squeezes(file, folder, session, hands, **more)


def _ask(
    names: list[str],
    check: Callable[[], None],
    what: str,
    *,
    down: tuple[float, ...] = (),
    number: int | None = None,
    lifted: bool = False,
) -> None:
    """Ask the operator at the terminal to act, and go on at Enter."""
    held = "take the object away" if number is None else f"hold {names[number]} between the fingers"
    let_go = "let go of the object: nothing but the fingers touches it"
    text = {
        "turn": f"turn the empty hand: gravity along {', '.join(f'{x:g}' for x in down)} (x, y, z)",
        "place": held,
        "carry": let_go if lifted else "support what the fingers hold, if anything",
    }[what]
    if answer(f"{text}; Enter: ", check) is None:
        raise ConfigError("no terminal to ask on; allowed: a terminal at the bench")
