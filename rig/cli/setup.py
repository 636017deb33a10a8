"""`tactile setup`: set a bench up step by step, and write its acceptance report."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import math
import os
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from recorder.command_line.errors import (
    EXIT_DEVICE_LOST,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_SAFETY_STOP,
)
from recorder.command_line.options import add_value
from rig.acquire import setup_checks as checks
from rig.acquire.acceptance import SetupRecord
from rig.acquire.calibration import store
from rig.acquire.control import apart
from rig.acquire.doctor import Finding, examine
from rig.bench.bench import Bench, BenchStream
from rig.bench.guards import force_limit
from rig.cli import doctor, force_depth
from rig.cli.calibrate_latency import calibrate
from rig.cli.home import find_by_force, find_by_signal
from rig.cli.options import (
    answer,
    banner,
    bench_command,
    bench_options,
    calibration_options,
    chosen_bench,
    require_terminal,
)
from rig.cli.recording import Recording, collect, started_bench
from rig.core import emulation
from rig.core.clock import SystemClock, file_stamp
from rig.core.config import from_si, to_si
from rig.core.errors import ConfigError, DeviceLost
from rig.core.geometry import compose
from rig.core.mock_names import PORTS
from rig.core.names import operator_name

Answers = dict[str, float]
Point = tuple[float, float, float]

# Time over which a gauge is averaged, and a signal is watched [s].
_WINDOW = 0.5
# On a mock bench, the tip in place of a finger: indentation as a fraction of the allowed one and at
# most, push, and height above the sensor when it is not used [m].
_FINGER, _FINGER_MOST, _PUSH, _CLEAR = 0.5, 6e-4, 2e-4, 0.03
_STEPS, _STEP_NS = 6, 30_000_000
# Taps of a second measurement of the latency, after one whose interval was too wide, and the width
# that it may have [s]: known that well is better than unknown.
_MORE_TAPS, _WIDE = 48, 5e-3
_DEVICES = ("arm", "force", "camera", "taxels", "streams")


class AtBench:
    """The bench during its set-up, the person at it, and the emulators of a mock bench.

    `given` are answers as text, of `--answer` or a correction; each is used once.
    """

    def __init__(self, options: argparse.Namespace, given: dict[str, str]) -> None:
        self.options = options
        self.given = given
        file = chosen_bench(options)
        self.file = file.with_indenter(options.indenter or "")
        self.clock = SystemClock()
        self.record = SetupRecord(options.calibrations, file)
        self._stack = contextlib.ExitStack()
        self._ready: Bench | None = None
        self.watch: Callable[[], None] | None = None
        """Raises if an emulator of a mock bench is gone."""
        self._tip: Point = (0.0, 0.0, _CLEAR)

    @property
    def bench(self) -> Bench:
        """The bench as its file describes it."""
        return self.file.bench

    @property
    def ready(self) -> Bench:
        """The bench with addresses filled in; a mock bench starts its emulators."""
        if self._ready is None:
            on = self._stack.enter_context(started_bench(self.file))
            self._ready = on.file.bench
            self.watch = on.watch
        return self._ready

    def close(self) -> None:
        """End the emulators; the next use starts them again."""
        self._ready = None
        self._tip = (0.0, 0.0, _CLEAR)
        self._stack.close()

    def ask(self, question: Question) -> float:
        """Return an answer: one that is given, the person's, or with `--yes` the usual one.

        A person's answers are kept, and offered when they are asked for again.
        """
        name, usual = question.name, question.usual(self.bench)
        text = self.given.pop(name, "")
        if not text and self.options.yes:
            return usual
        offered = self.record.answers.get(name, usual)
        while True:
            text = text or _read(f"  {question.text} [{offered:g}]: ") or str(offered)
            try:
                value = question.read(text, self.bench)
            except ConfigError as error:
                print(f"  {error}")
                text = ""
                continue
            self.record.answer(name, value)
            return value

    def do(self, text: str, *places: Point, force: Point = (0.0, 0.0, 0.0)) -> None:
        """Have the person do something at the bench; on a mock bench, its emulators do it.

        They lead the tip to `places` in the contact frame [m], and lay `force` on the sensor [N].
        """
        if not self.bench.mock:
            while typed := _read(f"  {text}; then Enter: "):
                if typed == "stop":
                    raise EOFError
                print(
                    f"  found {typed!r}; allowed: Enter alone once it is done, or stop; poses and "
                    "forces are read from the devices, not typed"
                )
            return
        print(f"  {text} (done by the mock bench)", flush=True)
        bench, ports = self.ready, PORTS
        host = self.ready.arm.host
        emulation.inject(host, ports["world"], "hand", force=force)
        frame = bench.world_frame or bench.contact_frame
        for position in places:
            # In small steps, which a simulated World can follow.
            for way in np.linspace(self._tip, position, _STEPS)[1:]:
                pose = compose(frame, (*way, *bench.tool_rotation)).tolist()
                emulation.inject(host, ports["arm"], "freedrive", pose=pose)
                self.clock.sleep_until(self.clock.now_ns() + _STEP_NS)
            self._tip = position
        # Longer than any emulated device averages or delays.
        self.clock.sleep_until(self.clock.now_ns() + 5 * _STEP_NS)

    def free(self) -> None:
        """Have nothing on the sensor."""
        self.do("take everything off the sensor", (0.0, 0.0, _CLEAR))

    def read(self, row: BenchStream, seconds: float = _WINDOW) -> list[Any]:
        """Return the values of a stream for a time [s], or longer if its readings must settle."""
        if self.watch is not None:
            self.watch()
        return checks.read_for(self.ready, row.name, self.clock, max(seconds, 2 * row.settling))

    def run(self, command: Callable[..., int], *arguments: object) -> int:
        """Run another command on this bench in a process of its own; return its exit code."""
        self.close()
        return apart(command, *arguments)

    def recording(self, name: str) -> Recording:
        """Return what a command that records gets, with the session to write."""
        path = self.options.out / f"{self.bench.sensor}-setup-{name}-{file_stamp()}.zarr"
        chosen = {"bench": self.file.path, "world": self.options.world, "force": self.options.force}
        return Recording(
            self.file, self.options.calibrations, self.options.operator, path, chosen=chosen
        )


# Steps: each returns or yields findings.


def network(at: AtBench, _: Answers) -> Iterable[Finding]:
    """Is every device of the network reached?"""
    return checks.network(at.ready)


def arm(at: AtBench, _: Answers) -> Iterable[Finding]:
    """Is the arm ready to be moved by this computer?"""
    return checks.arm(at.ready.arm.host, at.bench.preflight.timeout)


def tool(at: AtBench, answers: Answers) -> Iterable[Finding]:
    """Are TCP and payload those of the tool?"""
    return checks.tool(at.ready, at.clock, to_si(answers["length_mm"], "mm"))


def devices(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Are all devices and the computer well?"""
    with tempfile.TemporaryDirectory(prefix="tactile-rig-") as folder:
        yield from examine(at.ready, Path(folder), at.options.out, at.clock, at.watch)


def gauge(at: AtBench, answers: Answers) -> Iterator[Finding]:
    """Does each gauge show a known weight in newtons, with its sign?"""
    mass = 1e-3 * answers["weight_g"]
    # The mock bench has one weight, which may not be that of the answer.
    own = 0.1
    at.free()
    before = {row.name: checks.mean_of(at.read(row)) for row in at.ready.gauges}
    at.do(
        f"lay {1e3 * (own if at.bench.mock else mass):g} g on the middle of the sensor",
        force=(0.0, 0.0, -checks.GRAVITY * own),
    )
    after = {row.name: checks.mean_of(at.read(row)) for row in at.ready.gauges}
    at.free()
    for row in at.ready.gauges:
        yield checks.weight(row, (after[row.name] - before[row.name])[:3], mass)


def touch(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Does the signal show a light touch, which ends an approach in place of a gauge?"""
    row = at.ready.without_gauge[1]
    at.free()
    before = at.read(row, 20 / row.rate_hz)
    at.do("touch the middle of the sensor lightly with a finger", (0.0, 0.0, -_depth(at.bench)))
    after = at.read(row)
    at.free()
    yield checks.touch(at.ready, before, after)


def axes(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Do gauges, taxels and pictures show a push along +x and +y as such?"""
    rows = [row for row in at.ready.gauges if {"Fx", "Fy"} <= set(row.config.axes_measured)]
    rows += [row for row in at.ready.rows if row.kind in ("camera", "taxels")]
    ways: dict[str, list[np.ndarray]] = {row.name: [] for row in rows}
    still = dict.fromkeys(ways, 0.0)
    for axis, way in (("x", (1.0, 0.0)), ("y", (0.0, 1.0))):
        at.free()
        depth = _depth(at.bench)
        at.do(
            "press a finger on the middle of the sensor; hold it",
            (0.0, 0.0, 0.0),
            (0.0, 0.0, -depth),
        )
        before = {row.name: at.read(row) for row in rows}
        at.do(
            f"push it along +{axis} of contact_frame, lightly; hold it",
            (_PUSH * way[0], _PUSH * way[1], -depth),
        )
        for row in rows:
            ways[row.name].append(checks.direction(row, before[row.name], at.read(row)))
            half = (len(before[row.name]) + 1) // 2
            held = checks.direction(row, before[row.name][:half], before[row.name][-half:])
            still[row.name] = max(still[row.name], float(np.linalg.norm(held)))
    at.free()
    for row in rows:
        expected = at.bench.expected.at(_depth(at.bench))[0]
        along_x, along_y = ways[row.name]
        yield checks.axes(row, along_x, along_y, still[row.name], expected)


def _depth(bench: Bench) -> float:
    return min(_FINGER * bench.limits.depth_max, _FINGER_MOST)


def camera(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Is each camera named for good, exposed and in focus?"""
    for row in at.ready.of_kind("camera"):
        picture = at.read(row, 2 / row.rate_hz)[-1]
        if isinstance(picture, bytes):
            at.record.keep_picture(f"{row.name}.jpeg", picture)
        yield from checks.camera(row, picture)


def contact(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Is the origin of contact_frame where the tip touches the middle of the sensor?"""
    at.do(
        "lead the tip until it just touches the middle (freedrive or pendant in local mode, or "
        "tactile jog)",
        (0.0, 0.0, 0.0),
    )
    pose = np.array(at.read(at.ready.row("pose"), 0.1)[-1])
    at.do(f"lead the tip {1e3 * _CLEAR:.0f} mm up; back to remote control", (0.0, 0.0, _CLEAR))
    yield checks.contact(at.ready, pose)


def home(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Where is the surface, by touch?"""
    recording = at.recording("home")
    if at.bench.no_gauge:
        recording = dataclasses.replace(recording, out=at.options.out)
        code = at.run(find_by_signal, recording)
    else:
        code = at.run(find_by_force, recording)
    surface = store.load(at.options.calibrations, at.bench, at.bench.indenter)[0].home
    text = f"surface {1e3 * surface.shift:+.3f} mm of the bench file's" if surface else ""
    yield _outcome("home", code, text, "contact_frame in the bench file; tactile home says more")


def latency(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Latency of the signal: how late does it show what is there?"""
    code = at.run(calibrate, at.recording("calibrate-latency"))
    # On a busy computer the interval of a mock bench may be too wide; a person decides at a lab's.
    if code == EXIT_SAFETY_STOP and at.bench.mock:
        print(f"  again, with {_MORE_TAPS} taps, which narrow the interval", flush=True)
        again = functools.partial(calibrate, taps=_MORE_TAPS, width_max=_WIDE)
        code = at.run(again, at.recording("calibrate-latency"))
    calibration = store.load(at.options.calibrations, at.bench, at.bench.indenter)[0].latency
    text = ""
    if calibration:
        low, high = calibration.interval
        late = f"{calibration.stream} {1e3 * calibration.latency:+.1f} ms late"
        text = f"{late} (95 % in {1e3 * (high - low):.1f} ms)"
    yield _outcome("latency", code, text, "contrast and rate of the signal; --depth-mm deeper taps")


def press(at: AtBench, _: Answers) -> Iterator[Finding]:
    """Does the first press go well? Without a gauge it is made in steps."""
    curve = at.bench.force_depth is not None and bool(at.bench.gauges)
    recording = at.recording("force-depth" if curve else "collect")
    path = recording.session()
    record = force_depth.press if curve else functools.partial(collect, targets=1)
    code = at.run(record, recording)
    picture = path.with_suffix(".curve.png")
    if picture.exists():
        at.record.keep_picture("press.png", picture.read_bytes())
    yield _outcome("press", code, path.name, "its last lines name the cause; limits and plan")


def _outcome(part: str, code: int, text: str, *cures: str) -> Finding:
    if code == EXIT_DONE:
        return Finding(part, "well", text)
    if code == EXIT_INTERRUPTED:
        return Finding(part, "FAULT", "stopped by the operator", ("measure again, or skip",))
    if code == EXIT_DEVICE_LOST:
        cures = ("the command's last lines name the device: power, cable, a busy computer",)
    return Finding(part, "FAULT", f"stopped with exit code {code}", cures)


@dataclass(frozen=True, slots=True)
class Question:
    """A question of a step, whose answer is a number."""

    name: str
    """Key of the answer; it ends with the unit."""
    text: str
    usual: Callable[[Bench], float]
    span: Callable[[Bench], tuple[float, float]]
    """Least and largest number that can be true."""
    source: str
    """Origin of these limits."""
    mistaken: dict[str, float]
    """Size of other units that a person may have meant."""

    def read(self, text: str, bench: Bench) -> float:
        """Return the number in an answer.

        Raises:
            ConfigError: It is no number, or one that cannot be true; with the likely one.
        """
        low, high = self.span(bench)
        wrong = f"{self.name}: found {text!r}; allowed: {low:g} to {high:g} by {self.source}"
        try:
            number = float(text)
        except ValueError:
            one = re.fullmatch(r"[^\d]*?([-+]?\d+(?:[.,]\d+)?)[^\d]*", text)
            write = f"; write {one[1].replace(',', '.')}" if one else ""
            raise ConfigError(f"{wrong}, a number with a decimal point{write}") from None
        if low <= number <= high:
            return number
        meant = [(number * size, unit) for unit, size in self.mistaken.items()]
        if fits := [each for each in meant if low <= each[0] <= high]:
            likely, unit = min(fits, key=lambda each: abs(math.log(each[0] / self.usual(bench))))
            wrong += f"; is it in {unit}? then write {likely:.6g}"
        raise ConfigError(wrong)


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the set-up."""

    check: Callable[[AtBench, Answers], Iterable[Finding]]
    """Measures; its docstring is the question that it answers, its name that of the step."""
    keys: tuple[str, ...]
    """Sections of the bench file that it checks: it is repeated after they change."""
    asks: tuple[Question, ...] = ()
    needed: Callable[[Bench], bool] = lambda bench: True
    """False: the bench has nothing to check here."""

    @property
    def name(self) -> str:
        """Name of the step."""
        return self.check.__name__


STEPS = (
    Step(network, _DEVICES),
    Step(arm, ("arm",)),
    Step(
        tool,
        ("arm",),
        (
            Question(
                "length_mm",
                "distance from flange to tip, by a caliper [mm]",
                lambda bench: max(1.0, float(from_si(bench.arm.tcp[2], "mm"))),
                lambda bench: (max(1.0, 333 * bench.arm.tcp[2]), 1000.0),
                "arm.tcp in the bench file",
                {"cm": 10.0, "m": 1000.0, "inch": 25.4},
            ),
        ),
    ),
    Step(devices, (*_DEVICES, "gripper", "pedal", "preflight")),
    Step(
        gauge,
        ("force", "streams"),
        (
            Question(
                "weight_g",
                "mass of the known weight [g]",
                lambda bench: 100.0,
                lambda bench: (1.0, 1e3 * force_limit(bench) // checks.GRAVITY),
                "the guard's limit of force",
                {"kg": 1000.0, "N": 1000.0 / checks.GRAVITY},
            ),
        ),
        lambda bench: bool(bench.gauges),
    ),
    Step(touch, ("camera", "taxels", "stand_ins"), needed=lambda bench: bench.no_gauge),
    Step(
        axes,
        (*_DEVICES, "contact_frame"),
        needed=lambda bench: bool(bench.gauges) or bench.signal is not None,
    ),
    Step(camera, ("camera", "streams"), needed=lambda bench: bool(bench.of_kind("camera"))),
    Step(contact, ("arm", "contact_frame")),
    Step(home, ("arm", "contact_frame", "indenter")),
    Step(
        latency,
        ("camera", "taxels"),
        needed=lambda bench: bool(bench.gauges) and bench.signal is not None,
    ),
    Step(press, ("arm", "contact_frame", "limits", "stand_ins", "force_depth")),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    bench_options(parser)
    parser.description = (
        "Sets a bench up: one step after the other asks, measures, and names what is wrong with "
        "its cure. Finished steps are stored and skipped, until the part of the bench file that "
        "they checked changes. Ends in an acceptance report, which every session of the bench "
        "then carries. Answers are kept, and offered when they are asked for again. On a mock "
        "bench the emulators do what a person would. Exit code 0 at the end, 2 wrong input, 3 a "
        "fault or a skipped step, 130 stopped by Ctrl-C, Ctrl-D or the word stop."
    )
    parser.epilog = "Steps: " + ", ".join(step.name for step in STEPS) + "."
    parser.add_argument("--indenter", help="name of the indenter on the arm")
    parser.add_argument(
        "--again", action="append", choices=[step.name for step in STEPS], help="repeat this step"
    )
    parser.add_argument(
        "--yes", action="store_true", help="give the usual answers; on a mock bench"
    )
    parser.add_argument(
        "--answer",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help=f"answer of: {', '.join(ask.name for step in STEPS for ask in step.asks)}",
    )
    add_value(parser, "--out", "DIR", doctor.SESSIONS, "folder of sessions", Path)
    parser.add_argument("--operator", default="", help="operator's name (default: the login name)")
    calibration_options(parser)


def run(options: argparse.Namespace) -> int:
    """Go through the steps; return the exit code."""
    given: dict[str, str] = {}
    names = [ask.name for step in STEPS for ask in step.asks]
    for stated in options.answer:
        name, equals, given[name] = stated.partition("=")
        if not equals or name not in names:
            raise ConfigError(f"--answer: found {stated!r}; allowed: {'=, '.join(names)}=")
    for name in ("out", "calibrations"):
        setattr(options, name, _writable(f"--{name}", getattr(options, name)))
    at = AtBench(options, given)
    for ask in (each for step in STEPS for each in step.asks if each.name in given):
        ask.read(given[ask.name], at.bench)
    if at.bench.mock:
        print(banner(at.file), flush=True)
    elif options.yes:
        raise ConfigError("--yes: found with a lab bench; allowed on a mock bench")
    else:
        require_terminal()
    repeated, skipped = set(options.again or ()), set[str]()
    try:
        while True:
            with contextlib.closing(at):
                code = _steps(at, repeated, skipped)
            if code is not None:
                return code
            at = AtBench(options, given)  # the bench file may have been corrected meanwhile
    except (KeyboardInterrupt, EOFError):
        print(f"\nsetup: stopped; {_GOES_ON}")
        return EXIT_INTERRUPTED


_GOES_ON = "the same command goes on from there, and offers the answers given so far"


def _writable(option: str, folder: Path) -> Path:
    """Return a folder, made if it is not there; `~` is the user's own."""
    folder = Path(os.path.expanduser(folder))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return folder
    except OSError as error:
        raise ConfigError(
            f"{option}: {folder}: {error.strerror}; allowed: a folder that this user can write"
        ) from None


def _steps(at: AtBench, repeated: set[str], skipped: set[str]) -> int | None:
    """Go through the steps that are not done; return the exit code, None to begin again."""
    needed = [step for step in STEPS if step.needed(at.bench)]
    for number, step in enumerate(needed, 1):
        heading = f"{number}/{len(needed)} {step.name}"
        if at.record.done(step.name, step.keys) and step.name not in repeated:
            stored = at.record.steps[step.name]
            print(f"{heading}: done {stored['date_utc']}, {stored['state']}", flush=True)
            continue
        if step.name in skipped:
            print(f"{heading}: skipped", flush=True)
            continue
        print(f"{heading}: {(step.check.__doc__ or '').strip()}", flush=True)
        at.record.show(step.name, number, len(needed))
        answers = {question.name: at.ask(question) for question in step.asks}
        findings = _checked(at, step, answers)
        at.record.show(step.name, number, len(needed), findings)
        faulty = any(each.state == "FAULT" for each in findings)
        decision = _decision(at, step) if faulty else "accept"
        if decision == "again":
            return None
        if decision == "stop":
            print(f"setup: stopped at {step.name}; {_GOES_ON}")
            return EXIT_DEVICE_LOST
        if decision == "skip":
            skipped.add(step.name)
            continue
        at.record.add(step.name, step.keys, answers, findings)
        repeated.discard(step.name)
    if skipped:
        print(f"setup: no report yet, skipped: {', '.join(sorted(skipped))}; {_GOES_ON}")
        return EXIT_DEVICE_LOST
    if at.record.accepted is None:
        operator = operator_name(at.options.operator)
        at.record.accept([step.name for step in needed], operator)
    result = at.record.accepted and at.record.accepted["result"]
    following = bench_command("collect", at.options)
    print(f"setup: {result}; report: {at.record.report}; next: {following}")
    return EXIT_DONE


def _decision(at: AtBench, step: Step) -> str:
    """Return `again`, `accept`, `skip` or `stop`, as the person decides on a fault."""
    if at.options.yes:
        return "stop"
    allowed = "Enter to measure again with the bench file as it is now, accept, skip, stop"
    allowed += "".join(f", or another {question.name}" for question in step.asks)
    while typed := _read(f"  {allowed}: "):
        if typed in ("accept", "skip", "stop"):
            return typed
        if step.asks and any(map(str.isdigit, typed)):
            at.given[step.asks[0].name] = typed
            break
        print(f"  found {typed!r}; allowed: {allowed}")
    return "again"


def _checked(at: AtBench, step: Step, answers: Answers) -> list[Finding]:
    findings: list[Finding] = []
    try:
        for each in step.check(at, answers):
            findings.append(each)
            doctor.show(each)
    except (ConfigError, DeviceLost, OSError) as error:
        cure = "tactile doctor tests every device, and names the cure"
        findings.append(Finding(step.name, "FAULT", str(error), (cure,)))
        doctor.show(findings[-1])
    return findings


def _read(prompt: str) -> str:
    """Return the typed line; raise EOFError at the end of input, which Ctrl-D is."""
    line = answer(prompt)
    if line is None:
        raise EOFError
    return line.strip()
