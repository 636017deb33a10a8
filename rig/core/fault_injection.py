"""What can be wrong with a device's line: every message an emulator sends passes through here.

Faults, by name, with the values they take (`seconds` absent: until `clear`):

    freeze       seconds                      nothing leaves; connections stay
    slow         seconds fraction delay       only this part of the messages leaves, so late [s]
    garbage      seconds messages             the content is spoilt, for a time or so many messages
    wrong_units  seconds                      the device's own idea of it, see its emulator
    reorder      seconds every                each so-many-th message leaves after the next one
    duplicate    seconds every                each so-many-th message leaves twice
    unplug       seconds                      connections are closed and new ones refused
    replug, clear, state

While nothing is wrong, the cost is one look at a flag.
"""

from __future__ import annotations

import random
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rig.core.clock import SECOND_NS, Clock

# A message: bytes or text, as the device sends.
M = TypeVar("M")

# The values of each fault besides `seconds`, and what they are when not given.
_VALUES: dict[str, dict[str, float]] = {
    "freeze": {},
    "slow": {"fraction": 0.25, "delay": 0.0},
    "garbage": {"messages": 0},
    "wrong_units": {},
    "reorder": {"every": 10},
    "duplicate": {"every": 10},
    "unplug": {},
}

# Names of everything that can be wrong.
FAULTS = tuple(_VALUES)


@dataclass(slots=True)
class _Active:
    """One fault that is on."""

    until_ns: int | None
    values: dict[str, float]
    seen: int = 0
    """Messages that came while it was on."""


def spoilt_bytes(message: bytes, rng: random.Random) -> bytes:
    """As many bytes, all of them random."""
    return rng.randbytes(len(message))


def spoilt_text(message: str, rng: random.Random) -> str:
    """As many characters, in disorder."""
    return "".join(rng.sample(message, len(message)))


class Disturbance(Generic[M]):
    """The faults of one device's line.

    Args:
        clock: Ends what was asked for a time.
        spoil: Makes garbage of a message.
        mistake: A message in the wrong units, None when `on_change` sees to that.
        on_change: Called after `unplug`, `replug`, `wrong_units`, `clear`, and when one of them has
            run out, for what a message alone cannot show: look at `unplugged` and `wrong_units`.
        seed: Of the garbage.
    """

    def __init__(
        self,
        clock: Clock,
        *,
        spoil: Callable[[M, random.Random], M],
        mistake: Callable[[M], M] | None = None,
        on_change: Callable[[], None] | None = None,
        seed: int = 0,
    ) -> None:
        self._clock = clock
        self._spoil = spoil
        self._mistake = mistake
        self._on_change = on_change
        self._rng = random.Random(seed)
        self._lock = threading.RLock()
        self._active: dict[str, _Active] = {}
        self._delayed: deque[tuple[int, M]] = deque()
        self._held: M | None = None
        self._credit = 0.0
        self.on = False
        """Whether anything is wrong; while it is not, `passed` need not be asked."""
        self.touched = 0
        """Messages withheld, spoilt, moved or repeated so far."""

    @property
    def unplugged(self) -> bool:
        """Whether the cable is out."""
        return self._is("unplug")

    @property
    def wrong_units(self) -> bool:
        """Whether the device speaks in the wrong units."""
        return self._is("wrong_units")

    def inject(self, fault: str, **values: Any) -> dict[str, Any]:
        """Put a fault in, or take faults away; how the line is.

        Raises:
            ValueError: No such fault, or a value that is none of its own or no number.
        """
        with self._lock:
            if fault == "replug":
                self._end("unplug")
            elif fault == "clear":
                for name in tuple(self._active):
                    self._end(name)
            elif fault in _VALUES:
                self._begin(fault, values)
            elif fault != "state":
                raise ValueError(
                    f"fault: found {fault!r}; known: {', '.join(FAULTS)}, replug, clear, state"
                )
            self._expire()
            return {"active": sorted(self._active), "touched": self.touched}

    def passed(self, message: M) -> tuple[M, ...]:
        """What leaves the device in place of `message`, in this order."""
        if not self.on:
            return (message,)
        with self._lock:
            self._expire()
            for active in self._active.values():
                active.seen += 1
            if "unplug" in self._active or "freeze" in self._active:
                self.touched += 1
                return ()
            leaving: tuple[M, ...] = ()
            for late in self._slowed(message):
                leaving += self._ordered(self._repeated(self._changed(late)))
            self._settle()
            return leaving

    def _is(self, fault: str) -> bool:
        if not self.on:
            return False
        with self._lock:
            self._expire()
            return fault in self._active

    def _begin(self, fault: str, values: dict[str, Any]) -> None:
        known = _VALUES[fault]
        given = {name: float(value) for name, value in values.items()}
        seconds = given.pop("seconds", None)
        unknown = sorted(set(given) - set(known))
        if unknown:
            raise ValueError(f"{fault}: unknown {unknown}; known: {sorted({*known, 'seconds'})}")
        until_ns = None
        if seconds is not None:
            until_ns = self._clock.now_ns() + round(seconds * SECOND_NS)
        self._active[fault] = _Active(until_ns, {**known, **given})
        self.on = True
        self._changed_outside(fault)

    def _end(self, fault: str) -> None:
        if self._active.pop(fault, None) is not None:
            self._changed_outside(fault)
        self._settle()

    def _changed_outside(self, fault: str) -> None:
        if self._on_change is not None and fault in ("unplug", "wrong_units"):
            self._on_change()

    def _expire(self) -> None:
        now_ns = self._clock.now_ns()
        for name, active in tuple(self._active.items()):
            spent = active.values.get("messages", 0)
            over = active.until_ns is not None and now_ns >= active.until_ns
            if over or 0 < spent <= active.seen:
                self._end(name)

    def _settle(self) -> None:
        """Stop looking at messages once nothing is wrong and nothing is held back."""
        self.on = bool(self._active or self._delayed or self._held is not None)

    def _slowed(self, message: M) -> tuple[M, ...]:
        """The messages whose time has come, this one perhaps among them."""
        slow = self._active.get("slow")
        now_ns = self._clock.now_ns()
        if slow is None:
            self._credit = 1.0
        else:
            self._credit += slow.values["fraction"]
        delay = 0.0 if slow is None else slow.values["delay"]
        if self._credit >= 1.0 - 1e-9:
            self._credit -= 1.0
            self._delayed.append((now_ns + round(delay * SECOND_NS), message))
            self.touched += delay > 0
        else:
            self.touched += 1
        due = []
        while self._delayed and self._delayed[0][0] <= now_ns:
            due.append(self._delayed.popleft()[1])
        return tuple(due)

    def _changed(self, message: M) -> M:
        if "wrong_units" in self._active:
            self.touched += 1
            if self._mistake is not None:
                message = self._mistake(message)
        if "garbage" in self._active:
            self.touched += 1
            return self._spoil(message, self._rng)
        return message

    def _repeated(self, message: M) -> tuple[M, ...]:
        duplicate = self._active.get("duplicate")
        if duplicate is None or duplicate.seen % max(int(duplicate.values["every"]), 1):
            return (message,)
        self.touched += 1
        return (message, message)

    def _ordered(self, messages: tuple[M, ...]) -> tuple[M, ...]:
        reorder = self._active.get("reorder")
        if self._held is not None:
            messages, self._held = (*messages, self._held), None
        elif reorder is not None and reorder.seen % max(int(reorder.values["every"]), 2) == 0:
            self.touched += 1
            self._held, messages = messages[-1], messages[:-1]
        return messages
