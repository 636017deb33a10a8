"""Wait for an event, however busy the machine is."""

import time
from collections.abc import Callable


def until(condition: Callable[[], object], pause: float = 0.01) -> None:
    """Return once the condition holds, looked at again after each pause [s]."""
    deadline = time.monotonic() + 240
    while not condition():
        assert time.monotonic() < deadline, "it did not come about"
        time.sleep(pause)
