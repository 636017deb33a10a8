"""`python -m benchmarks first-hour`: every command of a user's first hour, and its time.

Builds the wheel and installs it into a new environment. In a lab outside of the repository it tests
and sets up a mock bench, and records three sessions. It looks at one on the page by clicks in a
browser, marks two targets there, and records these again. It trains the smallest force model and
predicts forces as the mock bench is touched. Only the dependencies come from the network.
"""

import argparse
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from benchmarks.report import ROOT, Benchmark, Page, Part, Run, table
from recorder.charts import BLUE, chart
from recorder.command_line.errors import EXIT_DEVICE_LOST, EXIT_DONE
from recorder.progress import duration
from tactile.commands import COMMANDS
from tests.support.chromium import CHROMIUM, Chromium

SENSOR = "gelsight"
# Cone is one of the paper's six indenters that no training uses.
INDENTERS = ("sphere", "cylinder", "cone")
TARGETS, QUICK_TARGETS = 8, 3
AGAIN, QUICK_AGAIN = (3, 7), (1, 3)
# Times that a step on the mock bench is tried: on a busy machine an emulator may answer late.
TRIES = 3
# What a stopped collection prints before the command that goes on with it.
CONTINUE = "to continue: "
# Duration of the live prediction [s].
LIVE, QUICK_LIVE = 20, 4
_SHOWN = 3
# Commands on the mock bench, whose emulators run in real time, and the one that is used by clicks.
AT_BENCH, PAGE = ("doctor", "setup", "collect", "campaign", "live"), "page"


@dataclass(frozen=True, slots=True)
class Ran:
    """A command that ended: its time [s] has those of earlier tries."""

    command: str
    code: int
    lines: list[str]
    seconds: float
    tries: int


def steps(*, clicks: bool, quick: bool = False) -> Iterator[tuple[str, ...]]:
    """Yield the commands of `tactile`, the first in the folder that gets the lab.

    Args:
        clicks: Mark the targets to record again on the page; else they are named in a command.
        quick: Without the set-up of the bench, with few targets and the shortest training.
    """
    sensor = ("--sensor", SENSOR)
    yield "init", "lab"
    yield "doctor", *sensor
    if not quick:
        yield "setup", *sensor, "--yes"
    sessions = [f"sessions/{indenter}.zarr" for indenter in INDENTERS[: 1 if quick else None]]
    targets = str(QUICK_TARGETS if quick else TARGETS)
    for indenter, session in zip(INDENTERS, sessions, strict=False):
        chosen = ("--indenter", indenter, "--targets", targets, "--out", session)
        yield "collect", *sensor, *chosen
    yield "session", "info", sessions[0]
    yield "session", "info", sessions[0], "--picture", "sphere.png"
    if clicks:
        yield PAGE, "--port", "0"
        yield "campaign", "--file", "campaigns/again.yaml", "--yes"
    else:
        again = ",".join(map(str, QUICK_AGAIN if quick else AGAIN))
        yield "collect", "--resume", sessions[0], "--again", again
    yield "session", "check", sessions[0]
    yield "markers", *sessions, "--out", "gel.markers.zarr", "--sheet", "gel.png"
    learned = ("gel.markers.zarr", *sensor)
    yield "train", "force", *learned, "--preset", "tiny", "--out", "runs/force"
    yield "predict", "runs/force", *learned, "--out", "results/force.npz"
    yield "evaluate", "results", "--out", "report"
    seconds = str(QUICK_LIVE if quick else LIVE)
    live = ("--model", "runs/force", "--seconds", seconds, "--out", "forces.csv")
    yield "live", *sensor, *live


def measure(run: Run) -> dict[str, Any]:
    """Run the commands one after the other, until one fails; return their times."""
    quick, environment = run.quick, run.options.venv
    if quick and environment is None:
        environment = Path(sys.prefix)
    wanted = list(steps(clicks=CHROMIUM is not None, quick=quick))
    done: list[Ran] = []
    for each in _commands(run, environment, wanted):
        done.append(each)
        run.progress(len(done) / (len(wanted) + 3))
        if each.code != EXIT_DONE:
            output = "\n".join(each.lines[-20:])
            run.failures.append(f"{each.command}: exit code {each.code}:\n{output}")
            break
    return {"commands": [{**asdict(each), "lines": each.lines[-_SHOWN:]} for each in done]}


def _commands(run: Run, environment: Path | None, wanted: Sequence[Sequence[str]]) -> Iterator[Ran]:
    if environment is None:
        environment = run.folder / "venv"
        yield from installed(run.folder, environment)
    tactile = environment.resolve() / "bin" / "tactile"
    for number, words in enumerate(wanted):
        place = run.folder / "lab" if number else run.folder
        command = [str(tactile), *words]
        if words[0] == PAGE:
            yield clicked(command, place, run.options.picture, QUICK_AGAIN if run.quick else AGAIN)
        else:
            yield ran(command, place, words[0] in AT_BENCH)


def installed(folder: Path, environment: Path) -> Iterator[Ran]:
    """Build the wheel of this checkout's index, and install it into a new environment."""
    # A copy: a build in the checkout would pack what an earlier one left there.
    source, wheels = folder / "source", folder / "wheels"
    copy = ["git", "checkout-index", "--all", f"--prefix={source}/"]
    subprocess.run(copy, cwd=ROOT, check=True)
    pip = ["-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = ["wheel", "--no-deps", "--wheel-dir", str(wheels), str(source)]
    yield ran([sys.executable, *pip, *build], folder)
    yield ran([sys.executable, "-m", "venv", str(environment)], folder)
    (wheel,) = wheels.glob("*.whl")
    install = ["install", "-c", str(ROOT / "constraints.txt"), f"{wheel}[rig,learning]"]
    yield ran([str(environment / "bin" / "python"), *pip, *install], folder)


def ran(words: Sequence[str], place: Path, at_bench: bool = False) -> Ran:
    """Run one command in a folder.

    `at_bench`: run it again, or continue as it says, when a device of the mock bench was lost.
    """
    first, code, lines, tries = shown(words), EXIT_DEVICE_LOST, [""], 0
    began = time.monotonic()
    while code == EXIT_DEVICE_LOST and tries < (TRIES if at_bench else 1):
        tries += 1
        done = _started(words, place, stdin=subprocess.DEVNULL)
        output, _ = done.communicate()
        code = done.returncode
        # Progress is rewritten in place.
        lines = [line.rpartition("\r")[2].rstrip() for line in output.splitlines()]
        lines = [line for line in lines if line]
        for line in lines:
            if line.startswith(CONTINUE):
                words = [words[0], *shlex.split(line.removeprefix(CONTINUE))[1:]]
    return Ran(first, code, lines, time.monotonic() - began, tries)


def clicked(
    words: Sequence[str], place: Path, picture: Path | None, again: Sequence[int] = AGAIN
) -> Ran:
    """Serve the page and use it in a browser as a user does; optionally take a picture (PNG)."""
    began, failed = time.monotonic(), False
    served = _started(words, place)
    assert served.stdout is not None
    lines = [served.stdout.readline().rstrip()]
    try:
        address = re.search(r"watch it at (http\S+)", lines[0])
        with Chromium() as browser:
            if address is None:
                raise RuntimeError("no address was printed")
            lines += look(browser, address[1], picture, again)
    except (AssertionError, RuntimeError) as error:
        failed = True
        lines += str(error).splitlines()
    finally:
        served.send_signal(signal.SIGINT)
        rest, _ = served.communicate()
    lines += rest.splitlines()
    code = 1 if failed else served.returncode
    return Ran(shown(words), code, lines, time.monotonic() - began, 1)


def look(
    browser: Chromium, address: str, picture: Path | None, again: Sequence[int]
) -> Iterator[str]:
    """Look at the first session of the lab on the page and mark targets; yield its contents.

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
    for target in again:
        browser.click(f"#r-map [data-index='{target - 1}']")
        browser.until(f"{text('r-cell')}.startsWith('Target {target}:')")
        browser.click("#mark")
        browser.until(f"{text('marked')}.endsWith('{target}')")
    yield browser.eval(text("marked"))
    yield f"at the bench: {browser.eval(text('command'))}"
    if picture is not None:
        browser.screenshot(picture)


def _started(words: Sequence[str], place: Path, stdin: int | None = None) -> subprocess.Popen[str]:
    """Start a command with the environment of a user who has no repository."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    pipe, merged = subprocess.PIPE, subprocess.STDOUT
    return subprocess.Popen(
        words, cwd=place, env=environment, stdin=stdin, stdout=pipe, stderr=merged, text=True
    )


def shown(words: Sequence[str]) -> str:
    """Return a command as text, without the folders of files outside of the lab."""
    return shlex.join([Path(word).name if word.startswith("/") else word for word in words])


def named(command: str) -> str:
    """Return command and subcommand: `tactile session info ...` is `session info`."""
    words = [word for word in command.split()[1:] if not word.startswith("-")]
    both = " ".join(words[:2])
    return both if words[0] == "pip" or both in COMMANDS else words[0]


def section(values: dict[str, Any], page: Page) -> str:
    """Return the times of the commands as table and chart, and the last lines."""
    commands = values["commands"]
    with chart(page.picture("times"), 8, 0.8 + 0.25 * len(commands)) as figure:
        axes = figure.subplots()
        names = [f"{row} {named(each['command'])}" for row, each in enumerate(commands, 1)]
        axes.barh(names, [each["seconds"] for each in commands], color=BLUE)
        axes.set(xlabel="time [s]", ylim=(len(commands) - 0.5, -0.5))
    rows = [(f"`{each['command']}`", f"{each['seconds']:.0f}", each["tries"]) for each in commands]
    last = "\n".join(commands[-1]["lines"])
    return f"""## The commands

{len(commands)} commands in {duration(sum(each["seconds"] for each in commands))}, in an empty
folder outside of the checkout. Targets are marked on the page by clicks in a browser without a
window, if there is one. A command on the mock bench is run again if an emulator answered too late
(`tries`).

{page.link("times", "Time of each command")}

{table(("command", "time [s]", "tries"), rows)}

The last one ended with (its latency includes capture and markers, not the model alone):

```text
{last}
```"""


def _options(parser: argparse.ArgumentParser) -> None:
    venv = (
        "environment with tactile-rig[rig,learning], in place of a wheel and a new one; no network"
    )
    parser.add_argument("--venv", type=Path, metavar="DIR", help=venv)
    parser.add_argument("--picture", type=Path, metavar="FILE", help="picture (PNG) of the page")


BENCHMARK = Benchmark(
    "first-hour",
    "A user's first hour",
    "How long is it from the wheel to live forces, by every command of a user's first hour? On the "
    "mock bench, in real time.",
    (Part("hour", measure, section),),
    options=_options,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
