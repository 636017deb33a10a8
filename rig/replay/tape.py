"""The part of a recording that one emulated device plays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recorder import Session
from recorder.session.reader import Stream
from rig.replay.wire import origin_ns


@dataclass(frozen=True, slots=True)
class Tape:
    """The rows of one stream in one run."""

    stream: Stream
    """Where they are."""
    rows: range
    """Which they are."""
    t_ns: npt.NDArray[np.int64]
    """Their times since the run's first sample in any stream [ns]."""


def load_tape(session: Session, names: tuple[str, ...], name: str, run: int) -> Tape:
    """The rows of stream `name` in a run, timed from the first sample of any of `names`.

    Raises:
        SessionError: No such stream, or a damaged one.
    """
    stream = session.streams[name]
    rows = session.rows_of_run(name, run)
    start = origin_ns(session, names, run) or 0
    return Tape(stream, range(*rows.indices(len(stream))), stream.t_ns[rows] - start)
