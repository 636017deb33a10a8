"""Memory for what was read last, shared by all readers of a process and limited in bytes.

A reader finds what it read through a weak reference; only `RECENT` keeps it alive. So the memory of
a program does not grow with the sessions that it opens.
"""

from __future__ import annotations

import os
import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import Any, Generic, TypeVar
from weakref import WeakValueDictionary

T = TypeVar("T")

# Largest size of everything kept [bytes].
LIMIT = 64 << 20
# Memory that the interpreter needs for one object that is kept: header, entries, reference [bytes].
_OBJECT_BYTES = 600


class Recent:
    """The objects used last, up to a total size."""

    def __init__(self, limit: int) -> None:
        """Keep up to `limit` bytes."""
        self.limit = limit
        self.nbytes = 0
        self._kept: OrderedDict[int, tuple[Any, int]] = OrderedDict()
        self._lock = threading.Lock()

    def keep(self, value: Any, nbytes: int) -> None:
        """Keep an object alive, as the one used last; those not used for longest are released.

        Args:
            value: The object; the same object may be given again.
            nbytes: Its size [bytes]; an object larger than the limit is not kept.
        """
        if nbytes > self.limit:
            return
        key = id(value)  # unique as long as the object is kept
        with self._lock:
            known = self._kept.pop(key, None)
            self._kept[key] = (value, nbytes)
            self.nbytes += nbytes - (known[1] if known else 0)
            while self.nbytes > self.limit:
                _, (_, released) = self._kept.popitem(last=False)
                self.nbytes -= released

    def clear(self) -> None:
        """Release everything; also in a forked process, where the lock may be held for ever."""
        self._lock = threading.Lock()
        self._kept.clear()
        self.nbytes = 0


RECENT = Recent(LIMIT)
os.register_at_fork(after_in_child=RECENT.clear)


class Kept(Generic[T]):
    """Values that one reader has read, as long as they are in memory. Pickled and copied empty."""

    def __init__(self) -> None:
        self._found: WeakValueDictionary[Hashable, T] = WeakValueDictionary()

    def get(self, key: Hashable, nbytes: int | None = None) -> T | None:
        """Return the value of a key, or None if it has to be read again.

        Args:
            key: The key.
            nbytes: Size of the value [bytes]; that of the array if None.
        """
        value = self._found.get(key)
        if value is not None:
            _keep(value, nbytes)
        return value

    def put(self, key: Hashable, value: T, nbytes: int | None = None) -> T:
        """Remember a value, which must support weak references, and return it."""
        self._found[key] = value
        _keep(value, nbytes)
        return value

    def __reduce__(self) -> tuple[Any, ...]:
        return (Kept, ())


def _keep(value: Any, nbytes: int | None) -> None:
    RECENT.keep(value, _OBJECT_BYTES + (value.nbytes if nbytes is None else nbytes))
