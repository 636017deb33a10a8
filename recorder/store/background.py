"""One thread for everything slow: sealing, encoding blocks, flushing to the disk."""

import threading
from collections import deque
from collections.abc import Callable


class Background:
    """Runs jobs in order, and a flush every `interval` seconds.

    The first job that fails stays at the head of the line, its error in `failure`; nothing runs
    behind it until `drain`.
    """

    def __init__(self, flush: Callable[[], None], *, interval: float, name: str) -> None:
        """Start the thread."""
        self.failure: OSError | None = None
        self._flush = flush
        self._interval = interval
        self._jobs: deque[Callable[[], None]] = deque()
        self._wake = threading.Event()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], None]) -> None:
        """Put a job in line. A job that fails must be safe to run again."""
        self._jobs.append(job)
        self._wake.set()

    def stop(self) -> None:
        """End the thread once the jobs in line are done or one has failed. Safe twice."""
        self._stopping = True
        self._wake.set()
        self._thread.join()

    def drain(self) -> None:
        """Run what is still in line in the calling thread, after `stop`.

        Raises:
            OSError: A job failed again.
        """
        while self._jobs:
            self._jobs[0]()
            self._jobs.popleft()
        self.failure = None

    def _run(self) -> None:
        while not self._stopping:
            self._wake.wait(self._interval)
            self._wake.clear()
            try:
                while self._jobs and self.failure is None:
                    self._jobs[0]()
                    self._jobs.popleft()
                if self.failure is None:
                    self._flush()
            except OSError as error:
                self.failure = error
