"""Progress of a verb, without the import of `recorder` in short runs."""

from __future__ import annotations

import threading
import time
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self, TextIO

if TYPE_CHECKING:
    from recorder.progress import Progress

# Time after which `recorder` is imported: less than its progress is silent [s].
WAIT = 1.5


class LateProgress:
    """`recorder.progress.Progress`, imported by a thread after `WAIT`.

    The import takes 0.2 s of CPU time, a third of the start of a verb.
    """

    def __init__(self, name: str, stream: TextIO, kernels: Path | None) -> None:
        self._name, self._stream, self._kernels = name, stream, kernels
        known = sum(1 for _ in kernels.iterdir()) if kernels and kernels.is_dir() else 0
        self._since = time.monotonic(), known
        self._share: float | None = None
        self._shown: Progress | None = None
        self._timer = threading.Timer(WAIT, self._show)
        self._timer.daemon = True

    def __call__(self, share: float) -> None:
        """Store the share done, 0 to 1."""
        self._share = share
        if self._shown is not None:
            self._shown(share)

    def __enter__(self) -> Self:
        self._timer.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._timer.cancel()
        self._timer.join()
        if self._shown is not None:
            self._shown.__exit__(kind, error, trace)

    def _show(self) -> None:
        from recorder.progress import Progress

        shown = Progress(self._name, self._stream, kernels=self._kernels, since=self._since)
        if self._share is not None:
            shown(self._share)
        self._shown = shown.__enter__()
