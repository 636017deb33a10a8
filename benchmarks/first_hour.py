"""From the wheel to live forces: every command of a user's first hour, in an empty folder.

    python -m benchmarks first-hour --page times.md

Builds the wheel and installs it into a new environment. In a lab outside of the repository it tests
and sets up a mock bench, and records three sessions. It looks at one on the page by clicks in a
browser, marks two targets there, and records these again. It trains the smallest force model and
predicts forces as the mock bench is touched. Every command is printed with its time. Only the
dependencies of the wheel come from the network.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.chromium import CHROMIUM, Chromium
from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from recorder.processes import cores
from recorder.progress import duration

ROOT = Path(__file__).parents[1]
SENSOR = "gelsight"
# Cone is one of the paper's six indenters that no training uses.
INDENTERS = ("sphere", "cylinder", "cone")
TARGETS = 8
AGAIN = (3, 7)
# Times that a step on the mock bench is tried: on a busy machine an emulator may answer late.
TRIES = 3
# What a stopped collection prints before the command that goes on with it.
CONTINUE = "to continue: "
# Lines of a command's output that are shown, and of one that failed.
SHOWN, SHOWN_FAILED = 3, 20
# Duration of the live prediction [s].
LIVE_S = 20


@dataclass(frozen=True, slots=True)
class Step:
    """One command of a user."""

    words: tuple[str, ...]
    at_bench: bool = False
    """On the mock bench, whose emulators run in real time."""
    by_clicks: bool = False
    """Serves the page, which is used by clicks until it is closed."""


@dataclass(frozen=True, slots=True)
class Ran:
    """A command that ended."""

    command: str
    code: int
    lines: list[str]
    """Its output."""
    seconds: float
    """Its time, with those of earlier tries [s]."""
    tries: int


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
    parser.add_argument("--page", type=Path, metavar="FILE", help="page of the times to write")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="picture (PNG) of the page to write"
    )


def run(options: argparse.Namespace) -> int:
    """Run all steps; return the exit code of the one that failed, or 0."""
    done: list[Ran] = []
    if CHROMIUM is None:
        print("first hour: found no chromium: the page is not opened, targets are named by hand")
    with tempfile.TemporaryDirectory(prefix="first-hour-") as name:
        folder = Path(name) if options.out is None else options.out.resolve()
        folder.mkdir(parents=True, exist_ok=True)
        for each in commands(folder, options.venv, options.picture):
            done.append(each)
            if each.code != EXIT_DONE:
                print(f"first hour: stopped by {each.command}, exit code {each.code}")
                return each.code
    took = duration(sum(each.seconds for each in done))
    last = done[-1].lines[-1] if done[-1].lines else ""
    print(f"first hour: {len(done)} commands in {took}, from the wheel to live forces: {last}")
    if options.page is not None:
        options.page.write_text(page(done))
    return EXIT_DONE


def commands(folder: Path, environment: Path | None, picture: Path | None) -> Iterator[Ran]:
    """Run the commands one after the other, in a new environment if there is none."""
    if environment is None:
        environment = folder / "venv"
        yield from installed(folder, environment)
    tactile = environment.resolve() / "bin" / "tactile"
    for number, step in enumerate(steps(clicks=CHROMIUM is not None)):
        place = folder if number == 0 else folder / "lab"
        words = [str(tactile), *step.words]
        yield clicked(words, place, picture) if step.by_clicks else ran(words, place, step.at_bench)


def steps(*, clicks: bool) -> Iterator[Step]:
    """Yield the commands of `tactile`, the first in the folder that gets the lab.

    Args:
        clicks: Mark the targets to record again on the page; else they are named in a command.
    """
    yield Step(("init", "lab"))
    yield Step(("doctor", "--sensor", SENSOR), at_bench=True)
    yield Step(("setup", "--sensor", SENSOR, "--yes"), at_bench=True)
    sessions = [f"sessions/{indenter}.zarr" for indenter in INDENTERS]
    for indenter, session in zip(INDENTERS, sessions, strict=True):
        chosen = ("--sensor", SENSOR, "--indenter", indenter, "--targets", str(TARGETS))
        yield Step(("collect", *chosen, "--out", session), at_bench=True)
    yield Step(("session", "info", sessions[0]))
    yield Step(("session", "info", sessions[0], "--picture", "sphere.png"))
    if clicks:
        yield Step(("page", "--port", "0"), by_clicks=True)
        yield Step(("campaign", "--file", "campaigns/again.yaml", "--yes"), at_bench=True)
    else:
        again = ",".join(map(str, AGAIN))
        yield Step(("collect", "--resume", sessions[0], "--again", again), at_bench=True)
    yield Step(("session", "check", sessions[0]))
    yield Step(("markers", *sessions, "--out", "gel.markers.zarr", "--sheet", "gel.png"))
    learned = ("gel.markers.zarr", "--sensor", SENSOR)
    yield Step(("train", "force", *learned, "--preset", "tiny", "--out", "runs/force"))
    yield Step(("predict", "runs/force", *learned, "--out", "results/force.npz"))
    yield Step(("evaluate", "results", "--out", "report"))
    live = ("--sensor", SENSOR, "--model", "runs/force", "--seconds", str(LIVE_S))
    yield Step(("live", *live, "--out", "forces.csv"), at_bench=True)


def installed(folder: Path, environment: Path) -> Iterator[Ran]:
    """Build the wheel of this checkout, and install it into a new environment."""
    # A copy: a build in the checkout would pack what an earlier one left there.
    source, wheels = folder / "source", folder / "wheels"
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
    pip = ["-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--wheel-dir", str(wheels), str(source)]
    yield ran([sys.executable, *pip, *build], folder)
    yield ran([sys.executable, "-m", "venv", str(environment)], folder)
    (wheel,) = wheels.glob("*.whl")
    install = ["install", "-c", str(ROOT / "constraints.txt"), f"{wheel}[rig,learning]"]
    yield ran([str(environment / "bin" / "python"), *pip, *install], folder)


def ran(words: Sequence[str], place: Path, at_bench: bool = False) -> Ran:
    """Run one command in a folder; print it, its last lines and its time.

    Args:
        words: The command.
        place: Folder.
        at_bench: Try it again, or continue, when a device of the mock bench was lost.
    """
    first, code, lines, seconds, tries = shown(words), EXIT_DEVICE_LOST, [""], 0.0, 0
    while code == EXIT_DEVICE_LOST and tries < (TRIES if at_bench else 1):
        tries += 1
        print(f"$ {shown(words)}", flush=True)
        began = time.monotonic()
        done = subprocess.run(
            words,
            cwd=place,
            env=_environment(),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            check=False,
        )
        took = time.monotonic() - began
        code, seconds = done.returncode, seconds + took
        # Progress is rewritten in place.
        lines = [line.rpartition("\r")[2].rstrip() for line in done.stdout.splitlines()]
        lines = [line for line in lines if line]
        for line in lines[-(SHOWN if code == EXIT_DONE else SHOWN_FAILED) :]:
            print(f"  {line}", flush=True)
        print(f"  {took:.1f} s", flush=True)
        # Again, or as the command itself said.
        for line in lines:
            if line.startswith(CONTINUE):
                words = [words[0], *shlex.split(line.removeprefix(CONTINUE))[1:]]
    return Ran(first, code, lines, seconds, tries)


def clicked(words: Sequence[str], place: Path, picture: Path | None) -> Ran:
    """Serve the page and use it in a browser as a user does: look at a session, mark two targets.

    Args:
        words: The command that serves it.
        place: Folder.
        picture: File for a picture of the page (PNG); None: none.
    """
    print(f"$ {shown(words)}", flush=True)
    began = time.monotonic()
    served = subprocess.Popen(
        words,
        cwd=place,
        env=_environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert served.stdout is not None
    lines = [served.stdout.readline().rstrip()]
    failed = False
    try:
        address = re.search(r"watch it at (http\S+)", lines[0])
        with Chromium() as browser:
            if address is None:
                raise RuntimeError("no address was printed")
            for line in look(browser, address[1], picture):
                lines.append(line)
                print(f"  {line}", flush=True)
    except (AssertionError, RuntimeError) as error:
        failed = True
        lines += str(error).splitlines()
    finally:
        served.send_signal(signal.SIGINT)
        rest, _ = served.communicate()
    lines += rest.splitlines()
    code = 1 if failed else served.returncode
    if code != EXIT_DONE:
        print("\n".join(f"  {line}" for line in lines[-SHOWN_FAILED:]), flush=True)
    took = time.monotonic() - began
    print(f"  {took:.1f} s", flush=True)
    return Ran(shown(words), code, lines, took, 1)


def look(browser: Chromium, address: str, picture: Path | None) -> Iterator[str]:
    """Look at the first session of the lab on the page and mark `AGAIN`; yield the visible results.

    Raises:
        AssertionError: Something does not appear.
    """
    text = "document.getElementById('{}').textContent".format
    frame = "Number(document.getElementById('view').dataset.frame)"
    browser.resize(1440, 900)
    browser.open(address)
    # The set-up of the bench has left sessions of its own.
    first = f"#list a[href$='{INDENTERS[0]}.zarr']"
    browser.until(f'document.querySelector("{first}") !== null')
    yield f"sessions: {browser.eval(text('found'))}"
    browser.click(first)
    browser.until(f"{frame} >= 0 && document.querySelector('#pictures img').naturalWidth > 0")
    before = browser.eval(frame)
    browser.click("#slider")
    browser.until(f"{frame} > {before}")
    yield f"replay: {browser.eval(text('place'))}"
    for target in AGAIN:
        browser.click(f"#r-map [data-index='{target - 1}']")
        browser.until(f"{text('r-cell')}.startsWith('Target {target}:')")
        browser.click("#mark")
        browser.until(f"{text('marked')}.endsWith('{target}')")
    yield browser.eval(text("marked"))
    yield f"at the bench: {browser.eval(text('command'))}"
    if picture is not None:
        browser.screenshot(picture)


def _environment() -> dict[str, str]:
    """Return the environment of a user without the repository."""
    return {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}


def shown(words: Sequence[str]) -> str:
    """Return a command as text, without the folders of files outside of the lab."""
    return shlex.join([Path(word).name if word.startswith("/") else word for word in words])


def page(done: Sequence[Ran]) -> str:
    """Return the page of results."""
    rows = "\n".join(
        f"| `{each.command}` | {each.seconds:.0f} | {each.tries if each.tries > 1 else ''} |"
        for each in done
    )
    took = duration(sum(each.seconds for each in done))
    last = "\n".join(done[-1].lines[-SHOWN:])
    return f"""# A user's first hour

Every command from the wheel to live forces, in a new environment and an empty folder, on the mock
bench: {len(done)} commands in {took}. One run on {cores()} cores, made by
`python -m benchmarks first-hour --page FILE`.

| command | time [s] | tries |
|---|---|---|
{rows}

The last one ended with:

```text
{last}
```

A command on the mock bench is tried again when an emulator answered too late (a busy computer).
"""
