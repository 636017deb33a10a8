"""Grip by force: a state machine that closes a gripper by what its two fingers feel. No I/O.

It closes count by count until both fingers touch, then until they press as hard as the load along
the skins needs. A slip shows the friction: the grip becomes tighter at once. A force beyond the
limit is eased. Without good forces of both fingers, or without the gripper's status, nothing moves:
the gripper keeps its position. It opens only when asked to, and only if the object stands.

A 2F-85 controls forces from 20 N upwards; a soft skin bears less. So every force here is one of a
position, in counts of the gripper. This has not been tried on a real gripper.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

from rig.core.finger import FingerForce
from rig.devices.gripper import robotiq_wire as wire

# Least force that a 2F-85 controls by itself [N].
LEAST_OWN_FORCE = 20.0
# Position at which the fingers of a 2F touch each other, counts.
CLOSED = 230
# Least friction that is learned from a slip: below it, the finger has noticed something else.
LEAST_FRICTION = 0.1
# Part of the wanted force that skins may lose by relaxing before it is restored.
SLACK = 0.08
# Most counts of one command.
STRIDE = 3


@dataclass(frozen=True, slots=True)
class GripSettings:
    """Settings of a grip by force.

    Raises:
        ValueError: A value is out of range.
    """

    touch: float = 0.15
    """Normal force at which a finger counts as touching [N]."""
    least: float = 0.3
    """Normal force before the object is lifted [N]."""
    margin: float = 1.2
    """Grip force over the least one by the friction as it is known."""
    friction: float = 0.8
    """Coefficient of friction assumed until a slip shows a lower one."""
    limit: float = 10.0
    """Largest normal force of a finger [N]."""
    travel: int = 5
    """Most counts from touch, which bound the depth of the skins."""
    stale: float = 0.1
    """Age of a force beyond which nothing moves [s]."""
    patience: float = 0.5
    """Time without good forces or status after which the grip is given up as it is [s]."""

    def __post_init__(self) -> None:
        above = {"touch": 0, "least": 0, "friction": 0, "stale": 0, "patience": 0}
        for name, low in {**above, "margin": 1, "travel": 1}.items():
            value = getattr(self, name)
            if not (low < value < math.inf or value == low == 1):
                allowed = "1 or more" if low else "above 0"
                raise ValueError(f"{name}: found {value!r}; allowed: {allowed}")
        if not self.least <= self.limit <= LEAST_OWN_FORCE:
            raise ValueError(
                f"limit: found {self.limit!r} N; allowed: {self.least:g} (least) to "
                f"{LEAST_OWN_FORCE:g}, from where the gripper controls forces by itself"
            )


@dataclass(frozen=True, slots=True)
class Senses:
    """Newest values of one cycle."""

    t_ns: int
    left: FingerForce | None
    right: FingerForce | None
    status: wire.GripperStatus | None
    status_ns: int
    """Time of the status."""
    aloft: bool
    """True if nothing but the fingers bears the object."""
    allowed: bool = True
    """False if a dead-man pedal is not held."""
    release: bool = False
    """True if a person, or a plan, asks to let go."""


class State(StrEnum):
    """State of a grip; from GIVEN_UP and LOST only a person's release leads on."""

    CLOSING = "closing"
    HOLDING = "holding"
    REFUSED = "refused"
    LOST = "lost"
    GIVEN_UP = "given up"
    OPENED = "opened"


class ForceGrip:
    """One grip, from open fingers to the release."""

    def __init__(self, settings: GripSettings) -> None:
        self._settings = settings
        self.state = State.CLOSING
        self.reason = ""
        """Reason of the state, as text; also of a pause."""
        self.friction = settings.friction
        """Coefficient of friction, as assumed or as the last slip showed."""
        self.wanted = settings.least
        """Normal force that the load needs, with the margin [N]."""
        self.normal = 0.0
        """Mean normal force of the fingers [N]."""
        self.firm = False
        """True if the last forces were as wanted and nothing slipped: the object may be lifted."""
        self.position = -1
        """Position to which the fingers were sent, counts; -1 before the first status."""
        self._touched_at: int | None = None
        self._rests_ns: int | None = None
        self._bad_ns: int | None = None
        self._judged, self._was_firm = (0, 0), False
        self._empty, self._closed_by, self._gain = 0, 0, 0.0  # frames, counts, N per count

    def step(self, senses: Senses) -> wire.GripperCommand | None:
        """Return the gripper's next command; None: it keeps its position."""
        self._was_firm, self.firm = self.firm, False
        if senses.release and not senses.aloft and senses.status is not None and senses.allowed:
            self._become(State.OPENED, "released")
            return self._to(0)
        if self.state in (State.OPENED, State.GIVEN_UP, State.LOST):
            return None
        if reason := self._lost_gripper(senses):
            self._become(State.GIVEN_UP, reason)
            return None
        good = self._good(senses)
        if isinstance(good, str):
            self._bad_ns = senses.t_ns if self._bad_ns is None else self._bad_ns
            self.reason = good
            if senses.t_ns - self._bad_ns > 1e9 * self._settings.patience:
                self._become(State.GIVEN_UP, good)
            return None
        self._bad_ns = None
        if not senses.allowed:
            self.reason = "the pedal is not held"
            return None
        status, left, right = good
        if not self._is_settled(status, senses.status_ns, left, right):
            self.firm = self._was_firm and self._rests_ns is not None
            return None
        return self._judge(left, right)

    def _lost_gripper(self, senses: Senses) -> str:
        """Return the reason why the gripper cannot be commanded, or an empty text."""
        status = senses.status
        if status is None:
            return ""
        if senses.t_ns - senses.status_ns > 1e9 * self._settings.patience:
            return "the gripper does not answer"
        if status.fault:
            return f"gripper: fault {status.fault}: {wire.fault_text(status.fault)}"
        if status.state != wire.ACTIVE:
            return "the gripper is not active"
        if status.object == wire.STOPPED_CLOSING and status.position < status.requested:
            return f"the fingers are stopped at {status.position} of 255 by {LEAST_OWN_FORCE:g} N"
        return ""

    def _good(self, senses: Senses) -> str | tuple[wire.GripperStatus, FingerForce, FingerForce]:
        """Return the status and the forces, or the reason why they are none to act on."""
        status, left, right = senses.status, senses.left, senses.right
        if status is None:
            return "no status of the gripper yet"
        if left is None or right is None:
            return f"{'left' if left is None else 'right'} finger: no force yet"
        for one in (left, right):
            age = 1e-9 * (senses.t_ns - one.t_ns)
            if not -1e-3 <= age <= self._settings.stale:
                return f"{one.finger} finger: its force is {1e3 * age:.0f} ms old"
            if not all(map(math.isfinite, (*one.force, *one.half_width))):
                return f"{one.finger} finger: its force or interval is not a number"
            if one.outside:
                return f"{one.finger} finger: its frame is unlike those that the model learned from"
        apart = abs(left.force[2] - right.force[2])
        # Frames of two sensors are of different times while the fingers move.
        if self._rests(left, right) and apart > left.half_width[2] + right.half_width[2]:
            return f"the fingers' normal forces differ by {apart:.2f} N, more than their intervals"
        return status, left, right

    def _is_settled(
        self, status: wire.GripperStatus, status_ns: int, left: FingerForce, right: FingerForce
    ) -> bool:
        """Return True if the fingers rest where they were sent, and both have felt it since."""
        if self.position < 0:
            self.position, self._rests_ns = status.position, status_ns
        elif self._rests_ns is None:
            arrived = status.requested == self.position and status.object != wire.MOVING
            self._rests_ns = status_ns if arrived else None
        times = left.t_ns, right.t_ns
        if not self._rests(left, right) or times == self._judged:
            return False
        self._judged = times
        return True

    def _rests(self, left: FingerForce, right: FingerForce) -> bool:
        return self._rests_ns is not None and min(left.t_ns, right.t_ns) >= self._rests_ns

    def _judge(self, left: FingerForce, right: FingerForce) -> wire.GripperCommand | None:
        settings, before = self._settings, self.normal
        # A frame shows the slip since the one before it, which may be of the position before.
        slipped = (left.slipping or right.slipping) and not self._closed_by
        normals = -left.force[2], -right.force[2]
        self.normal = 0.5 * sum(normals)
        if self.state != State.REFUSED:
            self.reason = ""
        load = 0.5 * (math.hypot(*left.force[:2]) + math.hypot(*right.force[:2]))
        if self._touched_at is None:
            if min(normals) < settings.touch:
                return self._close(1)
            self._touched_at, self.state = self.position, State.HOLDING
        elif self._closed_by:
            self._gain = max((self.normal - before) / self._closed_by, 0.0)
        self._closed_by = 0
        self._empty = self._empty + 1 if self.normal < 0.5 * settings.touch else 0
        if self._empty:
            if self._empty > 1:
                self._become(State.LOST, "neither finger feels the object any more")
            return None
        shown = load / max(self.normal, settings.touch)
        if slipped and shown > LEAST_FRICTION:
            self.friction = min(self.friction, shown)
        self.wanted = max(settings.margin * load / self.friction, settings.least)
        if max(normals) > settings.limit:
            self.reason = f"{max(normals):.1f} N on a finger; the limit is {settings.limit:g} N"
            return self._to(max(self.position - 1, self._touched_at))
        missing = self.wanted - self.normal
        enough = missing <= (SLACK * self.wanted if self._was_firm else 0.0)
        if self.state == State.REFUSED or (enough and not slipped):
            self.firm = self.state == State.HOLDING
            return None
        counts = math.ceil(missing / self._gain) if self._gain else 1
        return self._close(min(max(counts, 1), STRIDE), slipped=slipped)

    def _close(self, counts: int, *, slipped: bool = False) -> wire.GripperCommand | None:
        """Return the command of some counts more, as far as the limits allow any."""
        settings, limit = self._settings, self._settings.limit
        if self._touched_at is None:
            if self.position >= CLOSED:
                self._become(State.LOST, "closed on nothing")
                return None
        else:
            counts = min(counts, settings.travel - (self.position - self._touched_at))
            while counts > 0 and self.normal + counts * self._gain > limit:
                counts -= 1
            if counts < 1:
                limits = f"the limits are {limit:g} N and {settings.travel} counts from touch"
                reason = f"{'slips at ' if slipped else ''}{self.normal:.1f} N: {limits}"
                self._become(State.REFUSED if slipped else self.state, reason)
                self.firm = not slipped
                return None
        self._closed_by = counts
        return self._to(self.position + counts)

    def _to(self, position: int) -> wire.GripperCommand | None:
        """Return the command to a position; None if the fingers are sent there already."""
        if position == self.position:
            return None
        self.position, self._rests_ns = position, None
        return wire.GripperCommand(go=True, position=position, speed=0, force=0)

    def _become(self, state: State, reason: str) -> None:
        self.state, self.reason = state, reason
