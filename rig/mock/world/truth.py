"""Log of the World's true states, from which the ideal readings at any time follow."""

from pathlib import Path

import numpy as np

from rig.core.samples import WORLD_STATE


class TruthLog:
    """Appends states to a file of plain WORLD_STATE records."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("ab")

    def append(self, state: np.void) -> None:
        """Add one WORLD_STATE."""
        self._file.write(state.tobytes())

    def close(self) -> None:
        """Write buffered records; may be called twice."""
        self._file.close()


class Truth:
    """Reads a truth log; a truncated last record is left out."""

    def __init__(self, path: Path) -> None:
        content = path.read_bytes()
        whole = len(content) - len(content) % WORLD_STATE.itemsize
        self.records = np.frombuffer(content[:whole], WORLD_STATE)

    def _at(self, name: str, t_ns: np.ndarray) -> np.ndarray:
        # Times are relative to the first: float64 would round nanoseconds since boot.
        origin = self.records["t_ns"][0]
        logged_ns = (self.records["t_ns"] - origin).astype(float)
        query_ns = (np.asarray(t_ns) - origin).astype(float)
        values = self.records[name].reshape(len(logged_ns), -1)
        return np.stack([np.interp(query_ns, logged_ns, column) for column in values.T], axis=-1)

    def wrench(self, t_ns: np.ndarray) -> np.ndarray:
        """Return the wrench (n, 6) at times (n,) [N, N m], linear between the arm's cycles."""
        return self._at("wrench", t_ns)

    def position(self, t_ns: np.ndarray) -> np.ndarray:
        """Return the TCP position (n, 3) in the base frame at times (n,) [m]."""
        return self._at("pose", t_ns)[:, :3]

    def depth(self, t_ns: np.ndarray) -> np.ndarray:
        """Return the indentation (n,) at times (n,) [m], negative above the surface."""
        return self._at("depth", t_ns)[:, 0]
