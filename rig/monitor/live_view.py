"""Live view of a page: the command that serves it, as the page's process knows it."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Mapping
from typing import Any, Generic, TypeVar

Item = TypeVar("Item")
# Rate at which a view reads the newest samples, for display only [Hz].
SAMPLE_RATE_HZ = 40.0


class Backlog(Generic[Item]):
    """The newest `most` items of a stream; each client gets those that it does not have."""

    def __init__(self, most: int) -> None:
        self._items: deque[Item] = deque(maxlen=most)
        self._total = 0

    def add(self, item: Item) -> None:
        """Add an item."""
        self._items.append(item)
        self._total += 1

    def clear(self) -> None:
        """Forget all items."""
        self._items.clear()

    def news(self, sent: Counter[str], name: str) -> list[Item]:
        """Return the items that a client does not have, and note under `name` that it has them."""
        new = min(self._total - sent[name], len(self._items))
        sent[name] = self._total
        return [self._items[k] for k in range(len(self._items) - new, len(self._items))]


class LiveView:
    """The live view of a page."""

    commands: tuple[str, ...] = ()
    """Commands that clients may send."""
    ended = False
    """True once the last state is known."""

    def hello(self) -> dict[str, Any]:
        """Return the constant data, with the name of the view as `live`."""
        raise NotImplementedError

    def news(self, sent: Counter[str], clients: Mapping[str, int]) -> list[dict[str, Any] | bytes]:
        """Return the state and pictures for a client, and note in `sent` that it has them.

        `clients` are counts of clients, by name.
        """
        raise NotImplementedError

    def receive(self, message: Any) -> None:
        """Receive what the command has sent."""
        raise NotImplementedError

    def lose(self) -> None:
        """Receive that the command's process is gone."""
        raise NotImplementedError

    def start(self) -> None:
        """Start what runs beside the server."""

    def sample(self) -> None:
        """Read the newest samples; called at `SAMPLE_RATE_HZ`."""

    def close(self) -> None:
        """Release all files; may be called twice."""


def number(value: Any, digits: int = 3) -> float | None:
    """Return a rounded float for JSON; None if it is not finite."""
    number = float(value)
    return round(number, digits) if math.isfinite(number) else None
