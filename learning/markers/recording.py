"""Sessions as rows of an archive: choice of frames, their metadata, and grouping of sessions."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from learning.errors import LearningError
from learning.indenters import coded
from recorder.session import Session, Stream, axes_of, surface_heights
from recorder.spec import AXES, PHASES
from trajectories import PressShear, plan_from_json

Integers = NDArray[np.int64]
Kind = Literal["camera", "taxels"]

# Kinds of plans whose sessions can be trained on.
KINDS_OF_PLAN = ("press_shear", "force_depth")

# Largest difference between shear directions of one number [rad].
ANGLE_TOLERANCE = math.radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The presses of one session, one for each target."""

    session: Session
    name: str
    """Name of its directory."""
    sensor: str
    indenter: str
    kind: Kind
    rows: Integers
    """Rows of `frames` (n,), press by press."""
    number: Integers
    """Number of each frame within its target (n,)."""
    references: Integers
    """Rows of the session's `reference` in use (K,)."""
    reference: Integers
    """Index into `references` of each row (n,)."""
    omitted: tuple[str, ...]
    """Descriptions of the session's frames that are not in `rows`."""
    finger: str = ""
    """Stream of the finger of a hand that is read; empty: the first of its kind."""
    first_target: int = 0
    """Number of its first target within the indenter, in an archive."""
    first_location: int | None = None
    """Location of its first target in an archive; None if its targets have no location."""

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def located(self) -> bool:
        """True if all targets have a shear direction, and so locations common to sensors."""
        return not self.finger and bool((self.session.plan_targets["direction"] >= 0).all())

    @property
    def is_imported(self) -> bool:
        """True if its presses have no plan of places: found in a recording, or by a hand."""
        attrs = self.session.attrs
        return bool(self.finger) or ("imported" in attrs and attrs.get("plan") is None)

    @property
    def is_placed(self) -> bool:
        """True if places and depths of its presses are known."""
        return "contact_frame" in self.session.attrs

    @property
    def targets(self) -> int:
        """Number of planned targets."""
        return len(self.session.plan_targets["point"])

    def surface(self) -> NDArray[np.float64]:
        """Return the height of the undeformed surface at each row's target (n,) [m]; 0 if flat."""
        heights = surface_heights(self.session)
        return np.zeros(len(self)) if self.finger else np.asarray(heights[self.column("target")])

    @property
    def camera(self) -> Stream:
        """Its first camera, whose images the column `image` of `frames` numbers."""
        name = self.finger or self.session.first("camera")
        if name is None:
            raise LearningError(f"{self.name}: has no camera")
        return self.session.streams[name]

    def picture(self, image: int) -> NDArray[np.uint8]:
        """Return one of the camera's images (h, w, 3), RGB."""
        (picture,) = self.camera.images([image])
        return np.asarray(picture)

    def reference_images(self) -> list[int]:
        """Return the image of each reference in use."""
        return [int(image) for image in self.session.reference[self.shown][self.references]]

    @property
    def shown(self) -> str:
        """Column of `frames` and `reference` with its images or taxels."""
        first = "image" if self.kind == "camera" else "taxels"
        return self.session.columns[self.finger] if self.finger else first

    def places(self) -> NDArray[np.int64]:
        """Return the number within the session of each row's place (n,): target, or squeeze."""
        target = self.column("target").astype(np.int64)
        return np.asarray(self.session.targets["point"])[target] if self.finger else target

    def squeezed(self) -> list[dict[str, Any]]:
        """Return mass borne, turn, step and steadiness of each row, of a finger; else nothing."""
        if not self.finger:
            return [{}] * len(self)
        targets, segments = self.session.targets, self.session.segments
        times, still = self.column("t_ns"), np.zeros(len(self), np.bool_)
        hold = round(1e9 * float(self.session.attrs["plan"]["hold"]))
        for end in segments["end_ns"][(segments["phase"] == 0) & (segments["outcome"] == 0)]:
            still |= (times >= end - hold) & (times < end)
        return [
            {
                "mass": float(targets["mass"][of] * targets["lifted"][of]),
                "turn": targets["turn"][of].tolist(),
                "step": int(targets["step"][of]),
                "still": bool(steady),
            }
            for of, steady in zip(self.column("target"), still, strict=True)
        ]

    def layout(self) -> NDArray[np.int64]:
        """Return point, depth level and direction of each target (t, 3), which pair sensors."""
        targets = self.session.plan_targets
        level = np.unique(targets["depth"].round(9), return_inverse=True)[1].reshape(-1)
        columns = [targets["point"], level, targets["direction"]]
        return np.stack([np.asarray(column, np.int64) for column in columns], axis=1)

    def plan(self) -> PressShear | None:
        """Return the press-shear plan stored in the session; None if there is none."""
        stored = self.session.attrs.get("plan")
        if not isinstance(stored, dict) or stored.get("kind") != PressShear.KIND:
            return None
        try:
            plan = plan_from_json(stored)
        except (TypeError, ValueError) as error:
            raise LearningError(f"{self.name}: {error}") from error
        return plan if isinstance(plan, PressShear) else None

    def column(self, name: str) -> NDArray[Any]:
        """Return a column of `frames` for the rows (n, ...)."""
        return np.asarray(self.session.frames[name][self.rows])

    def measured(self) -> NDArray[np.bool_]:
        """Return the axes Fx to Tz (6,) that the gauge measured; others were stored as 0 once."""
        for name, column in self.session.columns.items():
            if column == "wrench":
                axes = self.session.streams[name].attrs.get("axes_measured", AXES)
                return np.isin(AXES, axes)
        return np.ones(len(AXES), np.bool_)

    def invalid(self) -> list[str]:
        """Return the reason why each row has no frame (n,); empty if it has one."""
        frames = self.session.frames
        wrong = np.array(["" for _ in self.rows], dtype=object)
        wrong[~frames["valid"][self.rows]] = "a stream has no sample near enough"
        if self.kind == "camera":
            wrong[frames[self.shown][self.rows] < 0] = "no image"
        else:
            finite = np.isfinite(frames[self.shown][self.rows]).all(axis=(1, 2))
            wrong[~finite] = "no taxels"
        return [str(reason) for reason in wrong]

    def positions(self) -> NDArray[np.float64]:
        """Return tool positions in the contact frame (n, 3) [m]; NaN if not known at a time.

        They are 0 if no place of the session is known: the archive says so.
        """
        if not self.is_placed:
            return np.zeros((len(self), 3))
        frame = np.asarray(self.session.attrs["contact_frame"], np.float64)
        offset = self.column("pose")[:, :3] - frame[:3]
        return np.asarray(offset @ np.ascontiguousarray(axes_of(frame[3:]).T), np.float64)


def read_recordings(
    path: Path, sensor: str | None = None, finger: str | None = None
) -> list[Recording]:
    """Read the presses of a session: one recording, or of a finger of a hand one per object."""
    session = Session(path)
    fingers = session.attrs.get("fingers")
    if fingers is None and finger is None:
        return [_recording(session, sensor)]
    if not isinstance(fingers, dict) or finger not in fingers:
        allowed = f"--finger {' or '.join(fingers)}" if fingers else "a session of a hand"
        raise LearningError(f"{path.name}: found finger {finger}; allowed: {allowed}")
    whole = _recording(session, sensor or str(fingers[str(finger)]), str(finger))
    of_row = np.asarray(whole.session.targets["object"])[whole.column("target")]
    # A squeeze is one press: it begins without contact, from where markers are followed.
    place = whole.places()
    whole = replace(whole, number=np.arange(len(place)) - np.searchsorted(place, place))
    return [
        replace(
            whole,
            indenter=str(name),
            **{key: getattr(whole, key)[of_row == k] for key in ("rows", "number", "reference")},
        )
        for k, name in enumerate(whole.session.attrs["plan"]["objects"])
        if (of_row == k).any()
    ]


def read_recording(path: Path, sensor: str | None = None) -> Recording:
    """Read the presses of a session; `sensor` replaces the name in it."""
    return _recording(Session(path), sensor)


def _recording(session: Session, sensor: str | None, finger: str = "") -> Recording:
    name = Path(str(session.path)).name
    if session.warning:
        raise LearningError(session.warning)
    kind = _kind(session, name, finger)
    if not finger:
        _require_presses(session, name)
    rows, number, omitted = _once(session)
    if not len(rows):
        raise LearningError(f"{name}: found no frames of a press; allowed: one or more")
    shown = session.columns[finger] if finger else "image" if kind == "camera" else "taxels"
    references, reference = _references(session, rows, kind, name, shown)
    return Recording(
        session=session,
        name=name,
        sensor=sensor or _text(session, "sensor", name),
        indenter=_text(session, "indenter", name),
        kind=kind,
        rows=rows,
        number=number,
        references=references,
        reference=reference,
        omitted=tuple(omitted),
        finger=finger,
    )


def _kind(session: Session, name: str, signal: str) -> Kind:
    """Return the kind of the signal; of several cameras or taxel arrays the first is read."""
    if signal:
        return "camera" if session.streams[signal].traits.kind == "camera" else "taxels"
    if session.first("camera") is not None:
        return "camera"
    if session.first("taxels") is not None:
        return "taxels"
    raise LearningError(f"{name}: has neither camera nor taxels")


def _require_presses(session: Session, name: str) -> None:
    plan = session.attrs.get("plan")
    kind = plan.get("kind") if isinstance(plan, dict) else None
    if kind is not None and kind not in KINDS_OF_PLAN:
        raise LearningError(f"{name}: found plan {kind!r}; allowed: {', '.join(KINDS_OF_PLAN)}")
    if not len(session.targets.get("point", ())):
        raise LearningError(
            f"{name}: has no targets, so its frames cannot be assigned to presses; a recording "
            "made elsewhere gets those that `tactile import` finds"
        )
    session.require_frames()
    frame, imported = session.attrs.get("contact_frame"), session.attrs.get("imported")
    if isinstance(imported, dict) and imported.get("place") == "unknown":
        return
    if not isinstance(frame, list) or len(frame) != 6 or session.first("pose") is None:
        raise LearningError(
            f"{name}: has no pose or no contact_frame: the depth of its frames is unknown"
        )


def _text(session: Session, key: str, name: str) -> str:
    value = session.attrs.get(key)
    if not isinstance(value, str) or not value:
        raise LearningError(f"{name}: found {key} {value!r}; allowed: a name")
    return value


def _once(session: Session) -> tuple[Integers, Integers, list[str]]:
    """Return the rows of one press per target, and their numbers within it.

    An interrupted target was pressed again: the press with the most phases is used, and among
    equals the last.
    """
    frames = session.frames
    target, run, phase = frames["target"], frames["run"], frames["phase"]
    rows = np.flatnonzero((target >= 0) & (phase >= 0))
    # A new press begins with another target, another run, or a return to an earlier phase.
    another = (np.diff(target[rows]) != 0) | (np.diff(run[rows]) != 0)
    another |= np.diff(phase[rows].astype(np.int64)) < 0
    change = np.flatnonzero(another) + 1
    best: dict[int, Integers] = {}
    omitted = []
    for press in np.split(rows, change):
        if not len(press):
            continue
        of = int(target[press[0]])
        phases = len(np.unique(phase[press]))
        other = best.get(of)
        if other is not None and len(np.unique(phase[other])) > phases:
            press, other = other, press
        if other is not None:
            omitted.append(
                f"target {of} was pressed twice: {len(other)} frames of one press left out"
            )
        best[of] = press.astype(np.int64)
    presses = [best[of] for of in sorted(best)]
    # A force-depth press has no shear; contacts that were found have the phases that were found.
    plan = session.attrs.get("plan")
    straight = isinstance(plan, dict) and plan.get("kind") == "force_depth"
    expected = 2 if straight else len(PHASES)
    if isinstance(plan, dict) and plan.get("kind") == "squeeze":
        expected = 1
    if plan is None:
        expected = len(np.unique(session.segments["phase"]))
    missing = [of for of, press in best.items() if len(np.unique(phase[press])) < expected]
    if missing:
        omitted.append(f"{len(missing)} targets lack a phase, first {min(missing)}; they are kept")
    unpressed = len(session.plan_targets["point"]) - len(best)
    if unpressed:
        omitted.append(f"{unpressed} targets have no frames")
    none = np.zeros(0, np.int64)
    numbers = [np.arange(len(press)) for press in presses]
    return np.concatenate([none, *presses]), np.concatenate([none, *numbers]), omitted


def _references(
    session: Session, rows: Integers, kind: Kind, name: str, shown: str
) -> tuple[Integers, Integers]:
    """Return the rows of `reference` in use (K,), and the index of each row's reference (n,).

    As for the wrench, it is the latest of the target's point at or before the frame; else the
    latest of its run before it; else the first of its run; else the first of all.
    """
    reference = session.reference
    if kind == "camera":
        usable = np.flatnonzero(reference[shown] >= 0)
    else:
        usable = np.flatnonzero(np.isfinite(reference[shown]).all(axis=(1, 2)))
    if not usable.size:
        what = "image" if kind == "camera" else "counts"
        raise LearningError(f"{name}: has no reference: no {what} without contact")
    frames, point = session.frames, session.targets["point"]
    chosen = np.empty(len(rows), np.int64)
    change = np.flatnonzero(np.diff(frames["target"][rows])) + 1
    for begin, end in pairwise([0, *change.tolist(), len(rows)]):
        row = rows[begin]
        of_run = usable[reference["run"][usable] == frames["run"][row]]
        earlier = of_run[reference["t_ns"][of_run] <= frames["t_ns"][row]]
        own = earlier[reference["point"][earlier] == point[frames["target"][row]]]
        first = of_run[0] if of_run.size else usable[0]
        chosen[begin:end] = own[-1] if own.size else earlier[-1] if earlier.size else first
    used, which = np.unique(chosen, return_inverse=True)
    return used.astype(np.int64), which.reshape(-1).astype(np.int64)


# Grouping of sessions into one archive; incompatible sessions are rejected by name.


def read_group(
    paths: Sequence[Path], sensor: str | None = None, finger: str | None = None
) -> tuple[dict[str, list[Recording]], tuple[str, ...]]:
    """Return the recordings of each sensor, indenter by indenter, and the indenters by code.

    Targets of two sensors are paired by their numbers, so all sessions with shear must have the
    same plan: the same number of targets, points, depth levels and directions, shear angles within
    1 deg and one layout of points. The depth of a level may differ between sensors, but not within
    one. `sensor` replaces the names in the sessions.
    """
    if not paths:
        raise LearningError("sessions: found none; allowed: one or more")
    recordings = [one for path in paths for one in read_recordings(path, sensor, finger)]
    indenters = coded({one.indenter for one in recordings})
    _require_different(recordings)
    _require_alike(recordings)
    located = [one for one in recordings if one.located]
    targets = located[0].targets if located else 0
    by_sensor: dict[str, list[Recording]] = {}
    for one in recordings:
        by_sensor.setdefault(one.sensor, []).append(one)
    sensors = {}
    # Presses without a plan are numbered after all others: no two sensors share one.
    free = len(indenters) * targets
    for name, some in by_sensor.items():
        _require_one_device(some)
        some.sort(key=lambda one: (indenters.index(one.indenter), not one.located))
        placed = []
        begun = Counter[str]()
        for one in some:
            if one.is_imported:
                placed.append(replace(one, first_target=begun[one.indenter], first_location=free))
                begun[one.indenter] += one.targets
                free += one.targets
            elif one.located:
                first = indenters.index(one.indenter) * targets
                placed.append(replace(one, first_location=first))
            else:
                placed.append(replace(one, first_target=targets))
        sensors[name] = placed
    return sensors, indenters


def _require_different(recordings: Sequence[Recording]) -> None:
    earlier: dict[tuple[str, str, bool], Recording] = {}
    for one in recordings:
        if one.is_imported:
            _require_all_imported(one, recordings)
            continue
        key = one.sensor, one.indenter, one.located
        other = earlier.setdefault(key, one)
        if other is not one:
            raise LearningError(
                f"{one.name}: found {one.indenter} on {one.sensor}, as in {other.name}; allowed: "
                "one session for each indenter on a sensor (and one of force and depth)"
            )


def _require_all_imported(one: Recording, recordings: Sequence[Recording]) -> None:
    """Reject a sensor with presses of a plan beside others, or with known and unknown places."""
    for other in recordings:
        if other.sensor == one.sensor and (
            (other.is_imported, other.is_placed) != (one.is_imported, one.is_placed)
        ):
            raise LearningError(
                f"{one.name}: is imported, {other.name} of the same sensor was recorded by a plan "
                "or has other places; allowed: an archive for each, or another --sensor"
            )


def _require_alike(recordings: Sequence[Recording]) -> None:
    """Reject targets that cannot be paired, and depths that differ within a sensor."""
    located = [one for one in recordings if one.located]
    for one in located[1:]:
        other = located[0]
        if not np.array_equal(one.layout(), other.layout()):
            raise LearningError(
                f"{one.name}: found {one.targets} targets that are not those of {other.name} "
                f"({other.targets}); allowed: sessions of one plan, or an archive for each plan, "
                "joined by place with `archive join`"
            )
        _require_same_places(one, other)
    first: dict[str, Recording] = {}
    for one in located:
        other = first.setdefault(one.sensor, one)
        depth, due = one.session.plan_targets["depth"], other.session.plan_targets["depth"]
        if not np.allclose(depth, due, atol=1e-9):
            raise LearningError(
                f"{one.name}: found depths up to {1e3 * depth.max():g} mm, {other.name} of the "
                f"same sensor has {1e3 * due.max():g} mm; allowed: one plan for a sensor"
            )


def _require_same_places(one: Recording, other: Recording) -> None:
    """Reject plans in which one number means two shear angles, or two sides of the centre."""
    plan, due = one.plan(), other.plan()
    if plan is None or due is None:
        return
    count = int(one.session.plan_targets["direction"].max())
    if count * abs(plan.angle_step - due.angle_step) > ANGLE_TOLERANCE:
        raise LearningError(
            f"{one.name}: found shear directions {math.degrees(plan.angle_step):g} deg apart, "
            f"{other.name} has {math.degrees(due.angle_step):g} deg; allowed: the same angles, "
            "or an archive for each plan, joined by place with `archive join`"
        )
    for name in ("layout", "order"):
        own, expected = getattr(plan, name), getattr(due, name)
        if own != expected and (one.session.plan_targets["point"] > 1).any():
            raise LearningError(
                f"{one.name}: found {name} {own!r} of points, {other.name} has {expected!r}; "
                f"allowed: the same {name}, or an archive for each plan, joined by place with "
                "`archive join`"
            )


def _require_one_device(recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    for one in recordings[1:]:
        if one.kind != first.kind:
            raise LearningError(
                f"{one.name}: found {one.kind} of sensor {one.sensor}, {first.name} has "
                f"{first.kind}; allowed: one kind for a sensor"
            )
        if one.kind == "camera" and _size(one) != _size(first):
            raise LearningError(
                f"{one.name}: found pictures of {_size(one)}, {first.name} of the same sensor has "
                f"{_size(first)}; allowed: one size for a sensor"
            )


def _size(recording: Recording) -> tuple[int, ...]:
    return recording.camera.layout.columns[0].column.shape
