"""`tactile replay`: play a recorded session through mock hardware and record it again."""

import argparse
from pathlib import Path

from rig.core.clock import file_stamp


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Play a session through the emulators, record it again with the real drivers, "
        "and compare. Exit code 0: every stream has the same bytes; 1: some stream differs."
    )
    parser.add_argument("--session", type=Path, required=True, help="the session to replay")
    parser.add_argument(
        "--speed",
        type=_speed,
        default=1.0,
        help="multiple of the recorded speed, or max: as fast as the drivers read (default: 1)",
    )
    parser.add_argument("--out", type=Path, help="session to write (default: in sessions/)")
    parser.add_argument(
        "--without",
        action="append",
        default=[],
        metavar="STREAM",
        help="leave out this stream, such as a camera whose images are stored as pixels",
    )


def run(options: argparse.Namespace) -> int:
    """Replay; return the exit code."""
    from rig.cli.options import logged_to
    from rig.replay.replay import Replay, ReplayRequest

    source: Path = options.session
    out: Path | None = options.out
    if out is None:
        out = Path("sessions") / f"{source.stem}-replay-{file_stamp()}.zarr"
    request = ReplayRequest(source, out, options.speed, tuple(options.without))
    replay = Replay(request)
    out.parent.mkdir(parents=True, exist_ok=True)
    name = (
        request.speed_name if request.speed == 0 else f"{request.speed:g} times the recorded speed"
    )
    print(f"REPLAY of {source} ({name}): every device is an emulator, nothing moves", flush=True)
    with logged_to(out):
        return replay.run()


def _speed(text: str) -> float:
    """Parse a speed; max is returned as 0."""
    if text == "max":
        return 0.0
    try:
        speed = float(text)
    except ValueError:
        speed = 0.0
    if not 0.01 <= speed <= 1000:
        raise argparse.ArgumentTypeError(f"found {text!r}; allowed: 0.01 to 1000, or max")
    return speed
