"""`tactile collect` on a bench with a hand: squeeze objects between its two fingers."""

import argparse
import contextlib
import tempfile
from pathlib import Path

from rig.acquire.squeeze import Hands, collect_squeezes
from rig.bench.pair import PairFile
from rig.cli.options import answer, confirm, free_path, logged_to
from rig.core.clock import file_stamp
from rig.core.emulation import inject
from rig.core.errors import ConfigError
from rig.core.mock_names import PORTS

# Options of `collect` that a bench with a hand does not have.
_OTHERS = ("resume", "again", "indenter", "watch", "world", "force", "camera", "still", "taxels")


def run(options: argparse.Namespace, path: Path) -> int:
    """Collect a session of a hand; return the exit code.

    Raises:
        ConfigError: The file is invalid, or an option does not go with it.
    """
    for name in _OTHERS:
        if getattr(options, name, None):
            raise ConfigError(f"--{name}: does not go with the fingers of {path}")
    file = PairFile.read(path)
    bench = file.bench
    if options.truth and not bench.mock:
        raise ConfigError(f"--truth: {path} is a lab bench; allowed: a mock bench")
    if options.targets is not None and options.targets < 1:
        raise ConfigError(f"--targets: found {options.targets}; allowed: 1 or more")
    kind = "MOCK" if bench.mock else "LAB"
    print(f"{kind} BENCH ({path}): two fingers, no arm", flush=True)
    session = options.out or free_path(Path("sessions") / f"{bench.sensor}-{file_stamp()}.zarr")
    if not bench.mock:
        confirm(motion_lines(file), "squeeze")
    session.parent.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as stack:
        stack.enter_context(logged_to(session))
        temporary = tempfile.TemporaryDirectory(prefix="tactile-rig-")
        folder, watch = Path(stack.enter_context(temporary)), None
        hands: Hands = TerminalHands(file)
        if bench.mock:
            # Imported here, so that a collection on lab devices loads no emulator.
            from rig.mock.bench import MockHand

            mock = stack.enter_context(MockHand(file, folder, truth=options.truth))
            file, watch, hands = mock.file, mock.check, MockHands(mock.hosts["left"])
        more = {"operator": options.operator, "most": options.targets, "watch": watch}
        return collect_squeezes(file, folder, session, hands, **more)


def motion_lines(file: PairFile) -> list[str]:
    """Return how the gripper will move, as lines."""
    gripper, plan = file.bench.gripper, file.bench.squeeze
    return [
        f"fingers   close at speed {gripper.speed} and force {gripper.force} of 255, to at most "
        f"{1e3 * plan.deepest:g} mm less than an object's width",
        "objects   are placed and taken by you; the fingers open only after you hold them",
    ]


class TerminalHands:
    """Asks the operator, and goes on at Enter."""

    def __init__(self, file: PairFile) -> None:
        self._objects = file.bench.objects

    def turn(self, down: tuple[float, float, float]) -> None:
        """Ask for a turn of the hand."""
        x, y, z = down
        _ask(f"turn the empty hand: gravity along x {x:g}, y {y:g}, z {z:g} of its frame")

    def place(self, number: int | None) -> None:
        """Ask for an object."""
        if number is None:
            _ask("take the object away")
        else:
            name = self._objects[number].name
            _ask(f"hold the object {name} in the middle between the fingers")

    def carry(self, lifted: bool) -> None:
        """Ask to let go of the object, or to support it."""
        _ask("let go of the object; nothing but the fingers touches it" if lifted else "hold it")


def _ask(text: str) -> None:
    if answer(f"{text}; Enter: ") is None:
        raise ConfigError("no terminal to ask on; allowed: a terminal at the bench")


class MockHands:
    """Hands in the World of a mock at a loopback address."""

    def __init__(self, host: str) -> None:
        self._host = host

    def turn(self, down: tuple[float, float, float]) -> None:
        """Turn the hand."""
        inject(self._host, PORTS["world"], "turn", down=down)

    def place(self, number: int | None) -> None:
        """Place an object, or take it away."""
        inject(self._host, PORTS["world"], "place", number=number)

    def carry(self, lifted: bool) -> None:
        """Leave the object to the fingers, or support it."""
        inject(self._host, PORTS["world"], "carry", lifted=lifted)
