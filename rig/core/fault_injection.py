"""Faults of a device's connection: every message that an emulator sends passes through here.

Faults by name, with their values (without `seconds`, they last until `clear`):

    freeze       seconds                      no message leaves; connections stay open
    slow         seconds fraction             only this fraction of messages leaves
    garbage      seconds messages             corrupt content, for a time or a number of messages
    wrong_units  seconds                      as defined by the emulator of the device
    reorder      seconds every                every n-th message leaves after the next one
    duplicate    seconds every                every n-th message leaves twice
    unplug       seconds                      connections are closed and new ones refused
    replug, clear, state

Without a fault, the cost is a check of one flag.
"""

import random
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from rig.core.clock import SECOND_NS, Clock

# Message type: bytes or text, as the device sends.
M = TypeVar("M")

# Values of each fault other than `seconds`, with their defaults.
_VALUES: dict[str, dict[str, float]] = {
    "freeze": {},
    "slow": {"fraction": 0.25},
    "garbage": {"messages": 0},
    "wrong_units": {},
    "reorder": {"every": 10},
    "duplicate": {"every": 10},
    "unplug": {},
}

# Names of all faults.
FAULTS = tuple(_VALUES)


@dataclass(slots=True)
class _Active:
    until_ns: int | None
    values: dict[str, float]
    seen: int = 0
    """Messages that arrived while it was active."""


def corrupted_bytes(message: bytes, rng: random.Random) -> bytes:
    """Return random bytes of the same length."""
    return rng.randbytes(len(message))


def corrupted_text(message: str, rng: random.Random) -> str:
    """Return the same characters in random order."""
    return "".join(rng.sample(message, len(message)))


class FaultInjector(Generic[M]):
    """Fault injector for one device's connection, with a seed of its garbage.

    `spoil` corrupts a message, `mistake` converts one to the wrong units. `on_change` is called
    after `unplug`, `replug`, `wrong_units`, `clear`, and when one of them expires, for effects
    beyond single messages; it reads `unplugged` and `wrong_units`.
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
        self._held: M | None = None
        self._credit = 0.0
        self.on = False
        """True if any fault is active; otherwise `passed` need not be called."""
        self.touched = 0
        """Messages withheld, corrupted, moved or repeated so far."""

    @property
    def unplugged(self) -> bool:
        """True if the cable is unplugged."""
        return self._is("unplug")

    @property
    def wrong_units(self) -> bool:
        """True if the device sends wrong units."""
        return self._is("wrong_units")

    def inject(self, fault: str, **values: Any) -> dict[str, Any]:
        """Start a fault or end faults, and return the state of the connection."""
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
        """Return the messages that leave the device in place of `message`, in order."""
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
            if self._leaves():
                leaving = self._ordered(self._repeated(self._changed(message)))
            self._settle()
            return leaving

    def _is(self, fault: str) -> bool:
        if not self.on:
            return False
        with self._lock:
            self._expire()
            return fault in self._active

    def _begin(self, fault: str, values: dict[str, Any]) -> None:
        defaults = _VALUES[fault]
        overrides = {name: float(value) for name, value in values.items()}
        seconds = overrides.pop("seconds", None)
        unknown = sorted(set(overrides) - set(defaults))
        if unknown:
            raise ValueError(f"{fault}: unknown {unknown}; known: {sorted({*defaults, 'seconds'})}")
        until_ns = None
        if seconds is not None:
            until_ns = self._clock.now_ns() + round(seconds * SECOND_NS)
        self._active[fault] = _Active(until_ns, {**defaults, **overrides})
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
        """Stop processing messages once no fault is active and no message is held back."""
        self.on = bool(self._active or self._held is not None)

    def _leaves(self) -> bool:
        """Return True if a slow line sends this message; any other sends all."""
        slow = self._active.get("slow")
        self._credit = 1.0 if slow is None else self._credit + slow.values["fraction"]
        if self._credit < 1.0 - 1e-9:
            self.touched += 1
            return False
        self._credit -= 1.0
        return True

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
