"""Watches that a Net F/T box keeps the settings its stream was opened with.

Nothing in an RDT record says its units. Whoever changes them on the box's web page while it streams
changes the meaning of every count from then on, so the page is read again about once a second.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from rig.clock import Clock
from rig.errors import ConfigError, DeviceLost
from rig.force.rdt import Page

logger = logging.getLogger(__name__)

_PERIOD = 1.0
# The box's web server is slow, and shares the processor that makes the records [s].


class PageWatch:
    """A thread that reads the page until it is closed or the settings differ.

    Args:
        opened: The settings the stream was opened with.
        read: Reads the page; DeviceLost when it cannot be had, ConfigError when its units are
            unknown.
        changed: Called once with what is different.
        clock: Tells when the settings were last seen as they were.
    """

    def __init__(
        self, opened: Page, read: Callable[[], Page], changed: Callable[[str], None], clock: Clock
    ) -> None:
        self._opened = opened
        self._read = read
        self._changed = changed
        self._clock = clock
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="netft-page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop after the reading in progress; safe twice."""
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        reachable = True
        seen_ns = self._clock.now_ns()
        while not self._stopping.wait(_PERIOD):
            asked_ns = self._clock.now_ns()
            try:
                difference = _difference(self._opened, self._read())
                reachable = True
            except ConfigError as error:
                difference = str(error)
            except DeviceLost as error:
                # The records tell whether the box lives; a busy web server is no reason to stop.
                if reachable:
                    logger.warning("settings not read again: %s", error)
                reachable = False
                continue
            if difference:
                self._changed(
                    f"its settings were changed while it streamed ({difference}); values after "
                    f"t_ns = {seen_ns} are not to be trusted; set the box right, then resume"
                )
                return
            seen_ns = asked_ns


def _difference(opened: Page, found: Page) -> str:
    names = ("counts_per_force", "counts_per_torque", "force_unit", "torque_unit", "rate_hz")
    return ", ".join(
        f"{name} from {getattr(opened, name)} to {getattr(found, name)}"
        for name in names
        if getattr(opened, name) != getattr(found, name)
    )
