"""From the wheel to live forces: every command of a user's first hour, in an empty folder.

    python -m benchmarks first-hour

Builds the wheel and installs it into a new environment. In a lab outside of the repository it tests
and sets up a mock bench, records three sessions, looks at one and records two of its targets again.
It trains the smallest force model and predicts forces as the mock bench is touched. Every command
is printed with its time. Only the dependencies of the wheel come from the network.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from recorder.progress import duration

ROOT = Path(__file__).parents[1]
SENSOR = "gelsight"
# Cone is one of the paper's six indenters that no training uses.
INDENTERS = ("sphere", "cylinder", "cone")
TARGETS = 8
AGAIN = "3,7"
# Times that a step on the mock bench is tried: on a busy machine an emulator may answer late.
TRIES = 3
# What a stopped collection prints before the command that goes on with it.
CONTINUE = "to continue: "
# Lines of a command's output that are shown, and duration of the live prediction [s].
SHOWN = 3
LIVE_S = 20


@dataclass(frozen=True, slots=True)
class Step:
    """One command of a user."""

    words: tuple[str, ...]
    at_bench: bool = False
    """On the mock bench, whose emulators run in real time."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the script."""
    parser.description = (
        "Runs every command of a user's first hour, from the wheel to live forces, on a mock bench."
    )
    parser.add_argument(
        "--venv",
        type=Path,
        metavar="DIR",
        help="use this environment, in which tactile-rig[rig,learning] is installed, instead of a "
        "wheel and a new environment; no network",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="new folder that is kept (default: a temporary one)"
    )


def run(options: argparse.Namespace) -> int:
    """Run all steps; return the exit code of the one that failed, or 0."""
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="first-hour-") as name:
        folder = Path(name) if options.out is None else options.out.resolve()
        folder.mkdir(parents=True, exist_ok=True)
        environment = options.venv
        if environment is None:
            environment, code = installed(folder)
            if code != EXIT_DONE:
                return code
        tactile = environment.resolve() / "bin" / "tactile"
        count, last = 0, ""
        for number, step in enumerate(steps()):
            place = folder if number == 0 else folder / "lab"
            code, last = ran([str(tactile), *step.words], place, step.at_bench)
            if code != EXIT_DONE:
                print(f"first hour: stopped by tactile {shlex.join(step.words)}, exit code {code}")
                return code
            count += 1
    took = duration(time.monotonic() - began)
    print(f"first hour: {count} commands in {took}, from the wheel to live forces: {last}")
    return EXIT_DONE


def steps() -> Iterator[Step]:
    """Yield the commands of `tactile`, the first in the folder that gets the lab."""
    yield Step(("init", "lab"))
    yield Step(("doctor", "--sensor", SENSOR), at_bench=True)
    yield Step(("setup", "--sensor", SENSOR, "--yes"), at_bench=True)
    sessions = [f"sessions/{indenter}.zarr" for indenter in INDENTERS]
    for indenter, session in zip(INDENTERS, sessions, strict=True):
        chosen = ("--sensor", SENSOR, "--indenter", indenter, "--targets", str(TARGETS))
        yield Step(("collect", *chosen, "--out", session), at_bench=True)
    yield Step(("session", "info", sessions[0]))
    yield Step(("session", "sheet", sessions[0], "--output", "sphere.png"))
    yield Step(("collect", "--resume", sessions[0], "--again", AGAIN), at_bench=True)
    yield Step(("session", "check", sessions[0]))
    yield Step(("markers", *sessions, "--out", "gel.markers.zarr", "--sheet", "gel.png"))
    yield Step(("split", "gel.markers.zarr", "--out", "split.json"))
    learned = ("gel.markers.zarr", "--sensor", SENSOR, "--split", "split.json")
    yield Step(("train", "force", *learned, "--preset", "tiny", "--out", "runs/force"))
    yield Step(("predict", "runs/force", *learned, "--out", "results/force.npz"))
    yield Step(("evaluate", "results", "--out", "report"))
    yield Step(("card", "runs/force", "--out", "force.md"))
    live = ("--sensor", SENSOR, "--model", "runs/force", "--seconds", str(LIVE_S))
    yield Step(("live", *live, "--out", "forces.csv"), at_bench=True)


def installed(folder: Path) -> tuple[Path, int]:
    """Build the wheel of this checkout, and install it; return the environment and an exit code."""
    # A copy: a build in the checkout would pack what an earlier one left there.
    source, wheels, environment = (folder / name for name in ("source", "wheels", "venv"))
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    for name in filter(None, listed.split("\0")):
        if (ROOT / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(ROOT / name, source / name)
    python = str(environment / "bin" / "python")
    constraints = ("-c", str(ROOT / "constraints.txt"))
    build = ("wheel", "--quiet", "--no-deps", "--wheel-dir", str(wheels), str(source))
    for words in (
        [sys.executable, "-m", "pip", *build],
        [sys.executable, "-m", "venv", str(environment)],
        [python, "-m", "pip", "install", "--quiet", *constraints, "{wheel}[rig,learning]"],
    ):
        found = next(wheels.glob("*.whl"), None)
        code, _last = ran([word.replace("{wheel}", str(found)) for word in words], folder)
        if code != EXIT_DONE:
            break
    return environment, code


def ran(words: list[str], place: Path, at_bench: bool = False) -> tuple[int, str]:
    """Run one command in a folder; print it, its last lines and its time.

    Args:
        words: The command.
        place: Folder.
        at_bench: Try it again, or continue, when a device of the mock bench was lost.

    Returns:
        Its exit code, and its last line.
    """
    # As for a user without the repository, who came by no make.
    kept = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    kept.pop("TACTILE_DOOR", None)
    for _attempt in range(TRIES if at_bench else 1):
        print(f"$ {shlex.join([Path(words[0]).name, *words[1:]])}", flush=True)
        began = time.monotonic()
        done = subprocess.run(
            words,
            cwd=place,
            env=kept,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        took = time.monotonic() - began
        # Progress is rewritten in place.
        lines = [line.rpartition("\r")[2].rstrip() for line in done.stdout.splitlines()]
        lines = [line for line in lines if line]
        for line in lines[-SHOWN if done.returncode == EXIT_DONE else -20 :]:
            print(f"  {line}", flush=True)
        print(f"  {took:.1f} s", flush=True)
        if done.returncode != EXIT_DEVICE_LOST:
            break
        # Again, or as the command itself said.
        for line in lines:
            if line.startswith(CONTINUE):
                words = [words[0], *shlex.split(line.removeprefix(CONTINUE))[1:]]
    return done.returncode, lines[-1] if lines else ""
