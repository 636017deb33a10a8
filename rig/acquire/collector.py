"""Collection of one session: the operator's request, and its way from device check to summary."""

import contextlib
import importlib.metadata
import logging
import math
import platform
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from recorder import doubts
from recorder.command_line.errors import (
    EXIT_DEVICE_LOST,
    EXIT_DONE,
    EXIT_INTERRUPTED,
    EXIT_SAFETY_STOP,
)
from recorder.command_line.options import next_command
from recorder.command_line.terminal import paint, table
from recorder.errors import SessionError
from recorder.findings import Finding
from recorder.session import (
    Session,
    SessionWriter,
    accounts_of,
    clock_lines,
    contact_sheet,
    loss_lines,
    state_lines,
    time_lines,
)
from rig.acquire.calibration.store import Calibration
from rig.acquire.completed import first_open_target, left_out_of
from rig.acquire.control import Control, Interlocks, Interrupted, InterruptFlag, Onlooker
from rig.acquire.live_checks import LiveChecks
from rig.acquire.plan_runner import LiveLine, PlanRunner, last_line, rise_clear, zero_stand_ins
from rig.acquire.streams import Streams, check_clear, check_devices, notes_on, take_tares
from rig.bench.bench import Bench
from rig.bench.expected import mount_of
from rig.bench.guards import (
    force_limit,
    guard_limits,
    guards_of,
    left_out,
    left_out_text,
    statement,
)
from rig.bench.indenter import find_indenter
from rig.core.clock import ClockAnchor, SystemClock
from rig.core.errors import ConfigError, DeviceLost, SafetyStop
from rig.core.geometry import transform
from rig.core.guard import IMPOSSIBLE
from rig.core.load import Load, busy, explained
from rig.core.names import operator_name
from rig.devices.arm import dashboard
from rig.devices.arm.arm import Arm
from rig.devices.force.settings import AXES
from trajectories import Plan, PressShear, Target, plan_from_json, plan_to_json

logger = logging.getLogger(__name__)

# Errors that may end a run, and their exit codes.
_EXIT_CODES: dict[type[BaseException], int] = {
    Interrupted: EXIT_INTERRUPTED,
    KeyboardInterrupt: EXIT_INTERRUPTED,
    SafetyStop: EXIT_SAFETY_STOP,
    DeviceLost: EXIT_DEVICE_LOST,
    # A full or failing disk ends the session like a lost device.
    SessionError: EXIT_DEVICE_LOST,
    OSError: EXIT_DEVICE_LOST,
}
# Fewest targets of a session with a control press, and the least force to expect of it [N].
_TARGETS, _FORCE = 4, 0.1


@dataclass(frozen=True, slots=True)
class CollectRequest:
    """Request of the operator."""

    path: Path
    """The session: a new one, or with `resume` a stopped one."""
    plan: Plan
    """Targets of the session."""
    total: int
    """Number of the plan's targets in the session."""
    resume: bool = False
    """Continue with the first incomplete target."""
    again: tuple[int, ...] = ()
    """With `resume`, indices of targets to press again, done or not; readers use the last press."""
    operator: str = ""
    """Name of the operator; empty: the login name."""
    mock_sources: dict[str, Any] | None = None
    """Recordings that a mock bench's emulators play, for the session's attributes."""
    calibration: Calibration = field(default_factory=Calibration)
    """Earlier calibration that applies to this session."""
    left_out: Mapping[int, float] = field(default_factory=dict)
    """Targets that the bench cannot record, with the force that they would take [N]."""
    control: int | None = None
    """Target that is pressed again at the end, to compare both; None: none is."""
    contact_change: float = math.inf
    """Change of the signal that ends an approach on a bench without a gauge, in standard
    deviations of its noise; inf: none does."""
    after_target: Callable[[Target], None] | None = None
    """Called after each target, with the tip clear of the surface."""
    go_on: str = ""
    """Command that continues the session if it stops, or repeats it; empty: none is shown."""

    @classmethod
    def of(
        cls,
        bench: Bench,
        path: Path,
        plan: Plan | None = None,
        *,
        targets: int | None = None,
        resume: bool = False,
        again: tuple[int, ...] = (),
        **others: Any,
    ) -> Self:
        """Check a request against a bench: its plan or `plan`, or that of the resumed session.

        `targets` is the number of targets to press, None for all.
        """
        if not resume and path.exists():
            raise SessionError(f"{path}: exists already; resume it or choose another name")
        plan = bench.trajectory if plan is None else plan
        total = len(plan) if targets is None else targets
        if resume:
            plan, total = _resumed(path, bench)
            others["left_out"] = left_out_of(Session(path).attrs)
            others["control"] = next(iter(Session(path).controls.values()), None)
        if not 1 <= total <= len(plan):
            raise ConfigError(f"--targets: found {total}; allowed: 1 to {len(plan)}")
        walked = bench.check_limits(plan)
        if not resume:
            others["left_out"] = left_out(bench, plan, walked.depths[:total])
            others["control"] = _controlled(bench, plan, {*range(total)} - {*others["left_out"]})
        out = others["left_out"]
        if unknown := [index + 1 for index in again if not 0 <= index < total or index in out]:
            but = " without those left out" * bool(out)
            raise ConfigError(f"--again: found {unknown[0]}; allowed: targets 1 to {total}{but}")
        if len(out) == total:
            raise ConfigError(f"{bench.sensor}: {left_out_text(bench, out)}")
        return cls(path, plan, total, resume, again, **others)

    def depth(self, bench: Bench) -> float:
        """Return the deepest indentation of the targets that are not left out [m]."""
        depths = bench.dry_run(self.plan).depths[: self.total]
        return max(depth for index, depth in enumerate(depths) if index not in self.left_out)

    def to_press(self, first: int) -> tuple[Target, ...]:
        """Return the targets of this run in order: those to press again, and those from `first`.

        The control press, if there is one, is the last; its number is that after all others.
        """
        targets = list(self.plan.targets())
        pressed = [
            target
            for target in targets
            if (first <= target.index < self.total and target.index not in self.left_out)
            or target.index in self.again
        ]
        control = targets[self.control : self.control + 1] if self.control is not None else []
        return (*pressed, *(replace(target, index=self.total) for target in control))

    def is_complete(self) -> bool:
        """Return True if the session has nothing to resume: it was closed with all targets done."""
        session = Session(self.path)
        first = first_open_target(self.plan, session.segments, self.total, self.left_out)
        return first == self.total and session.status == "complete"


def _controlled(bench: Bench, plan: Plan, pressed: Collection[int]) -> int | None:
    """Return which of the targets that are pressed is repeated: the first of the deepest."""
    if not (bench.control_press and isinstance(plan, PressShear) and len(pressed) >= _TARGETS):
        return None
    targets = (target for target in plan.targets() if target.index in pressed)
    deepest = max(targets, key=lambda target: target.depth)
    return deepest.index if bench.expected.at(deepest.depth)[0] >= _FORCE else None


def _resumed(path: Path, bench: Bench) -> tuple[Plan, int]:
    """Return plan and number of targets of a session, which must be of the bench."""
    session = Session(path)
    attrs = session.attrs
    if attrs["sensor"] != bench.sensor:
        raise ConfigError(
            f"--sensor: found {bench.sensor!r}; {path} was recorded with {attrs['sensor']!r}"
        )
    recorded, present = set(session.streams), {row.name for row in bench.rows}
    if recorded != present:
        raise ConfigError(
            f"{path}: was recorded with the streams {', '.join(sorted(recorded))}; the bench file "
            f"has {', '.join(sorted(present))}; continue with the bench file of the recording "
            "(--bench), or record a new session"
        )
    try:
        plan = plan_from_json(attrs["plan"])
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: {error}") from None
    return plan, int(attrs["targets_wanted"])


class Collector:
    """Collects one session, or resumes one, on a bench whose addresses are filled in.

    `content` is that of its file, stored in the session; shared records are in `folder`. `watch`
    raises if a backend of the devices is gone, such as a mock bench's World; `page` displays the
    progress.
    """

    def __init__(
        self,
        bench: Bench,
        content: dict[str, Any],
        folder: Path,
        watch: Callable[[], None] | None = None,
        page: Onlooker | None = None,
    ) -> None:
        self._watch = watch
        self._page = page
        self._bench = bench
        self._content = content
        self._folder = folder
        self._clock = SystemClock()
        self._bias: dict[str, np.ndarray] = {}

    def run(self, request: CollectRequest) -> int:
        """Collect and return the exit code; what was recorded is closed however it ends."""
        started_ns = self._clock.now_ns()
        with InterruptFlag() as interrupt, contextlib.ExitStack() as stack:
            control = Control(interrupt)
            checks = LiveChecks(request.path)
            stack.callback(checks.close)
            streams = stack.enter_context(
                Streams(self._bench, self._folder, self._clock, self._watch)
            )
            interlocks = stack.enter_context(Interlocks(self._bench, control, self._clock))
            description, rates = check_devices(streams, interlocks)
            latency = request.calibration.latency
            signals = [row.name for row in self._bench.rows if "signal" in row.traits.roles]
            calibrated = [] if latency is None else [latency.stream]
            notes = notes_on(description, signals, calibrated)
            for note in notes:
                logger.info("preflight  note: %s", note)
            states = states_of(description)
            for state in states:
                logger.warning("preflight  %s", state)
            interrupt.check()
            check_clear(streams)
            self._zero_stand_ins(streams)
            arm = self._start_arm(request.contact_change)
            stack.callback(arm.close)
            rise_clear(streams, arm, interlocks)
            self._zero_stand_ins(streams)
            tares = take_tares(streams)
            interrupt.check()
            entry = {
                **_tare_entry(tares),
                "rates_hz": rates,
                "notes": notes,
                "states": states,
                "bench": self._content,
                "devices": description,
            }
            writer, first, run = self._open_session(request, entry, tares)
            targets = request.to_press(first)
            order = [target.index for target in targets]
            planned = self._bench.seconds(request.plan)[: request.total]
            live = LiveLine(streams, planned, pressing=order, new=checks.new)
            if self._page is not None:
                self._page.begin(control, live.progress, request.path, first)
            zeros = {name: tare["mean"] - self._bias[name] for name, tare in tares.items()}
            runner = PlanRunner(
                streams,
                arm,
                interlocks,
                writer,
                live,
                request.plan,
                after_target=request.after_target,
                run=run,
                zeros=zeros,
            )
            stop: BaseException | None = None
            try:
                for name, bias in self._bias.items():
                    streams[name].set_bias(bias)
                for handle in streams:
                    handle.record(writer.stream_path(handle.name))
                runner.press(targets)
            except BaseException as error:
                # On any error, the arm retracts and the session is closed before anything else.
                stop = _first_cause(error, interrupt, self._bench)
                if isinstance(stop, DeviceLost):
                    stop = explained(stop, mock=self._bench.mock, stalled=streams.stalled())
                live.end()
                logger.error("stopping: %s", str(stop) or type(stop).__name__)
            interrupt.ignore()
            live.tell()
            live.end()
            if self._page is not None:
                self._page.say("ending")
            retracted = self._retract(arm)
            status, reason = "complete", ""
            if stop is not None:
                status, reason = "stopped", str(stop) or type(stop).__name__
                if not retracted:
                    reason += "; THE ARM WAS NOT RETRACTED"
            try:
                done = sum(index not in request.left_out for index in range(first))
                pressed = targets[: runner.done]
                done += sum(first <= target.index < request.total for target in pressed)
                summaries = close_session(
                    self._bench.rate_hz, streams, writer, status, reason, done
                )
            except SessionError as error:
                print(error, file=sys.stderr)
                return EXIT_DEVICE_LOST
            code = exit_code(stop)
        seconds = (self._clock.now_ns() - started_ns) / 1e9
        show_session(request.path, summaries, live.doubts)
        line = last_line(
            status,
            reason,
            request.path,
            done=done,
            limited=runner.limited,
            left_out=len(request.left_out),
            total=request.total,
            seconds=seconds,
        )
        if stop is not None and request.go_on:
            print(f"to continue: {request.go_on}")
        print(paint(line, "good" if stop is None else "fault"))
        if self._page is not None:
            self._page.say(status, line)
        return code

    def _zero_stand_ins(self, streams: Streams) -> None:
        if self._bench.no_gauge:
            names = [row.name for row in self._bench.of_kind("arm_wrench")]
            window = self._bench.preflight.tare_window
            zero_stand_ins(streams, streams.measure(window, *(names or ["pose"])))

    def _start_arm(self, contact_change: float) -> Arm:
        arm = Arm(
            self._bench.arm,
            self._bench.contact_frame,
            guard_limits(self._bench),
            pose_path=self._folder / "pose.latest",
            guards=guards_of(self._bench, self._folder, contact=contact_change),
        )
        arm.start(self._bench.preflight.timeout)
        return arm

    def _open_session(
        self, request: CollectRequest, entry: dict[str, Any], tares: Mapping[str, Mapping[str, Any]]
    ) -> tuple[SessionWriter, int, int]:
        """Return the writer, the first target to press and the number of the run of this entry."""
        begun = {**asdict(ClockAnchor.take()), "operator": operator_name(request.operator), **entry}
        if request.resume:
            writer = SessionWriter.resume(request.path)
            previous = Session(request.path)
            first = first_open_target(
                request.plan, previous.segments, request.total, request.left_out
            )
            run = len(previous.runs)
            # The whole stream has one bias, so that raw = value + bias holds in every run. Drift of
            # the zero since then is recorded in this run's tare and references.
            self._bias = {name: np.array(previous.streams[name].attrs["bias"]) for name in tares}
        else:
            # An axis that is not measured may be NaN, and is stored as it came.
            self._bias = {name: np.nan_to_num(tare["mean"]) for name, tare in tares.items()}
            writer = SessionWriter.create(
                request.path,
                attrs=self._attrs(request, begun),
                streams=[
                    row.spec(
                        entry["devices"][row.name],
                        row.rate_hz,
                        **self._stream_attrs(row.name, request),
                    )
                    for row in self._bench.rows
                ],
                targets=target_table(request.plan, request.total, self._bench, request.control),
            )
            first, run = 0, 0
        writer.begin_run(begun)
        return writer, first, run

    def _attrs(self, request: CollectRequest, begun: dict[str, Any]) -> dict[str, Any]:
        bench = self._bench
        started = np.datetime64(begun["utc_ns"], "ns")
        return {
            "mock": bench.mock,
            "mock_sources": request.mock_sources or {},
            "sensor": bench.sensor,
            "indenter": bench.indenter,
            "indenter_description": find_indenter(bench.indenter).attrs(),
            "operator": begun["operator"],
            "plan": plan_to_json(request.plan),
            "targets_wanted": request.total,
            "bench": self._content,
            "contact_frame": list(bench.contact_frame),
            "rate_hz": bench.rate_hz,
            "started_utc": f"{started}Z",
            "clock": "CLOCK_MONOTONIC",
            "t0_ns": begun["t0_ns"],
            "software": software(),
            "calibration": request.calibration.attrs(),
            "expected_force": _expected(bench, request),
            "expected": _mount(bench, request),
            **({"without_gauge": statement(bench)} if bench.no_gauge else {}),
        }

    def _stream_attrs(self, name: str, request: CollectRequest) -> dict[str, Any]:
        """Return a stream's attributes other than the properties of its device."""
        if name in self._bias:
            gauge = self._bench.row(name).config
            axes, untrusted = gauge.axes_measured, gauge.UNTRUSTED_MASK
            more = {} if len(axes) == len(AXES) else {"axes_measured": list(axes)}
            more |= {"untrusted": untrusted} if untrusted else {}
            largest = [IMPOSSIBLE * rating for rating in self._bench.force_rating]
            return {"bias": self._bias[name].tolist(), "largest": largest, **more}
        attrs = request.calibration.stream_attrs(name)
        cameras = [row.name for row in self._bench.of_kind("camera")]
        played = request.mock_sources and "camera" in request.mock_sources
        if played and request.mock_sources and name in cameras[:1]:
            attrs["source_motion"] = request.mock_sources["camera"]["motion"]
        return attrs

    def _retract(self, arm: Arm) -> bool:
        """Retract the arm; return True if it is known to be clear."""
        try:
            if not arm.alive:
                return arm.recover_and_retract()
            return arm.retract()
        except (SafetyStop, DeviceLost) as error:
            logger.error("no retract: %s", error)
            return False


def exit_code(stop: BaseException | None) -> int:
    """Return the exit code of a run that an error has ended, if any; raise one that has no code."""
    if stop is None:
        return EXIT_DONE
    for kind, code in _EXIT_CODES.items():
        if isinstance(stop, kind):
            return code
    raise stop


def close_session(
    rate_hz: float, streams: Streams, writer: SessionWriter, status: str, reason: str, done: int
) -> dict[str, Any]:
    """End streams and session, with frames at a rate, and return the summaries of the streams.

    Raises:
        SessionError: The session could not be finished; its samples are kept.
    """
    summaries = streams.close()
    try:
        stood = sorted(span for each in summaries.values() for span in each.pop("stalls", ()))
        writer.end_run({"stalls_ns": stood})
        writer.set_attrs(summary=summaries, targets_done=done)
        writer.finish(status, reason, rate_hz=rate_hz, clocks=True)
    except OSError as error:
        raise SessionError(
            f"{writer.path}: could not be finished ({error}); its samples are kept: make room, "
            f"then run: {next_command('session', 'recover', writer.path)}"
        ) from error
    return summaries


def show_session(path: Path, summaries: Mapping[str, Any], known: Sequence[Finding] = ()) -> None:
    """Print what was recorded, with a contact sheet, and doubts that are not `known`."""
    session, picture = Session(path), path.with_suffix(".png")
    print(cadence(session, summaries))
    try:
        for line in clock_lines(session):
            print(line)
    except (SessionError, OSError) as error:
        logger.warning("no clocks: %s", error)
    try:
        contact_sheet(path, picture)
        print(f"contact sheet: {picture}")
    except (SessionError, OSError) as error:
        logger.warning("no contact sheet: %s", error)
    try:
        printed = {(one.code, one.where) for one in known}
        for doubt in doubts(session, images=False):
            if (doubt.code, doubt.where) not in printed:
                print(paint(str(doubt), doubt.level))
        if known:
            print(paint(f"warnings during the recording, above: {len(known)}", "warning"))
    except (SessionError, OSError) as error:
        logger.warning("no warnings: %s", error)


def _expected(bench: Bench, request: CollectRequest) -> dict[str, Any]:
    """Return the expected forces of the presses of a session, in SI units."""
    depths = bench.dry_run(request.plan).depths[: request.total]
    reached = sorted({round(depth, 9) for depth in depths})
    return {
        "skin": bench.expected.text,
        "depths": reached,
        "forces": [bench.expected.at(depth) for depth in reached],
        "limit": force_limit(bench),
        "left_out": [[index, force] for index, force in request.left_out.items()],
        "speed": bench.arm.speed,
        "reaction": request.calibration.reaction,
        "reaction_source": "assumed" if request.calibration.latency is None else "measured",
    }


def _first_cause(error: BaseException, interrupt: InterruptFlag, bench: Bench) -> BaseException:
    """Return the error that led to this one: the operator's stop, or that of the controller.

    `systemctl stop` and `timeout` send SIGTERM to all processes; the arm's process then retracts.
    A controller that stops ends more than one thing, of which another may be noticed first.
    """
    if isinstance(error, DeviceLost):
        try:
            interrupt.check()
            dashboard.check_ready(bench.arm.host, timeout=1.0)
        except (Interrupted, SafetyStop) as stop:
            return stop
        except DeviceLost as lost:
            local = "local control" in str(lost)
            return lost if local else error
    return error


def _tare_entry(tares: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the attributes of a run: `tare` of the first F/T sensor, `tares` of several."""
    entries = {
        name: {"mean": _or_null(tare["mean"]), "std": _or_null(tare["std"])}
        for name, tare in tares.items()
    }
    first = {"tare": next(iter(entries.values()))} if entries else {}
    return {**first, **({"tares": entries} if len(entries) > 1 else {})}


def _or_null(values: np.ndarray) -> list[float | None]:
    """Return numbers for JSON, which has no NaN: an axis that is not measured is null."""
    return [float(value) if np.isfinite(value) else None for value in values]


def target_table(
    plan: Plan, total: int, bench: Bench, control: int | None = None
) -> dict[str, np.ndarray]:
    """Return a session's `targets`: point, depth [m], direction, planned place in the base [m].

    The last row is a press that repeats the target `control`, if there is one.
    """
    targets = [target for target in plan.targets() if target.index < total]
    again = [] if control is None else [control]
    targets += [targets[index] for index in again]
    return {
        "point": np.array([target.point for target in targets], dtype=np.int16),
        "depth": np.array([target.depth for target in targets]),
        "direction": np.array([target.direction for target in targets], dtype=np.int16),
        "planned": transform(bench.contact_frame, [target.sheared for target in targets]),
        "control": np.array([-1] * total + again, np.int32),
    }


def states_of(description: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the states of computer and arm, of `Driver.describe()`, that a session should know."""
    version = str(description.get("pose", {}).get("controller_version", ""))
    return [state for state in (busy(Load.read()), dashboard.age_note(version)) if state]


def software() -> dict[str, str]:
    """Return the versions of the software that writes the session, for its metadata."""
    names = ("tactile-rig", "numpy", "zarr", "ur-rtde", "opencv-contrib-python-headless")
    versions = {"python": platform.python_version(), "system": platform.platform()}
    for name in names:
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            versions[name] = importlib.metadata.version(name)
    return versions


# Summary printed at the end: rates and gaps of the streams, and the recorded targets.


def cadence(session: Session, summaries: Mapping[str, Any]) -> str:
    """Return a table of the streams: expected and measured rate, longest gap, losses, skew."""
    accounts = accounts_of(session)
    lines = table(
        {
            "stream": list(accounts),
            "expected": [f"{session.streams[name].rate_hz:.0f} Hz" for name in accounts],
            "measured": [f"{account.measured_hz:.1f} Hz" for account in accounts.values()],
            "longest gap": [f"{1e3 * each.longest_gap:.1f} ms" for each in accounts.values()],
            "lost": [account.lost for account in accounts.values()],
            "": [omitted(summaries.get(name, {}).get("refused", {})) for name in accounts],
        },
        states=["fault" if account.lost else "" for account in accounts.values()],
    )
    lines += [*state_lines(session), *loss_lines(accounts), *time_lines(session)]
    frames = session.frames
    valid = np.asarray(frames["valid"], dtype=bool) if len(frames) else np.zeros(0, dtype=bool)
    if valid.any():
        skew = np.asarray(frames["skew"])[valid]
        invalid = int((~valid).sum())
        lines.append(
            f"{len(valid)} frames at {session.rate_hz:.0f} Hz, {invalid} invalid, "
            f"worst skew {1e3 * skew.max():.1f} ms (median {1e3 * np.median(skew):.2f} ms)"
        )
        lines.append(frames_per_target(session))
    return "\n".join(lines)


def omitted(rejected: Mapping[str, int]) -> str:
    """Return the counts of samples that were received but not stored, as text; empty if none."""
    counts = [f"{count} {reason}" for reason, count in rejected.items() if count]
    return f"left out: {', '.join(counts)}" if counts else ""


def frames_per_target(session: Session) -> str:
    """Return the frames per target, next to the paper's 20 to 60, as text."""
    frames = session.frames
    pressed = np.asarray(frames["target"]) >= 0
    # A target that was pressed again in another run counts for itself.
    presses = np.stack([np.asarray(frames[name])[pressed] for name in ("target", "run")], axis=1)
    fresh = ~np.asarray(frames["is_duplicate"], dtype=bool)[pressed]
    counts = np.unique(presses, axis=0, return_counts=True)[1]
    fresh_counts = np.unique(presses[fresh], axis=0, return_counts=True)[1]
    if not len(counts) or not len(fresh_counts):
        return "no frames in any target"
    return (
        f"frames per target: {counts.min()} to {counts.max()}, mean {counts.mean():.0f} "
        f"(without repeats: mean {fresh_counts.mean():.0f}; paper: 20 to 60)"
    )


def _mount(bench: Bench, request: CollectRequest) -> dict[str, Any]:
    """Return how tool, sensor and gauge lie, as far as the World or the set-up tells it."""
    steps = (request.calibration.acceptance or {}).get("steps", {})
    mount: dict[str, Any] = {"turned": 0.0} if steps.get("axes") == "well" else {}
    if bench.world is not None:
        mount = {} if request.mock_sources else mount_of(bench.world)
    return {"tool": bench.tool_pose((0.0, 0.0, 0.0))[3:].tolist(), **mount}
