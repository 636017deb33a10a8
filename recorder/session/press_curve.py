"""Force over depth of a session of straight presses: loading and unloading curve per press."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recorder.charts import BLUE, RED
from recorder.errors import SessionError
from recorder.plot import Curve, line_plot
from recorder.session.presses import DOWN, UP, Phase, Presses
from recorder.session.reader import Session

Floats = NDArray[np.float64]

_SIZE = (960, 640)
_STEPS = 121


@dataclass(frozen=True, slots=True)
class PressCurves:
    """Normal force at common depths; NaN at depths that a press did not reach."""

    depth: Floats
    """Common depths (m,) [m], ascending from 0."""
    target: NDArray[np.int64]
    """Target of each press (r,)."""
    loading: Floats
    """Compression on the way down (r, m) [N]."""
    unloading: Floats
    """Compression on the way up (r, m) [N]."""

    def work(self, curve: Floats) -> Floats:
        """Return the work of each press (r,) along `curve` [J]."""
        force = np.where(np.isfinite(curve), curve, 0.0)
        middle = (force[:, 1:] + force[:, :-1]) / 2
        return np.asarray(middle @ np.diff(self.depth))

    def lines(self) -> list[str]:
        """Return a table as text, one line per press."""
        lines = [
            f"{'press':<7}{'depth':>9}{'force':>10}{'loading':>12}{'unloading':>12}{'lost':>8}"
        ]
        rows = zip(self.target, self.work(self.loading), self.work(self.unloading), strict=True)
        for row, (target, work_in, work_out) in enumerate(rows):
            reached = np.flatnonzero(np.isfinite(self.loading[row]))
            deepest = 1e3 * self.depth[reached[-1]] if reached.size else np.nan
            largest = np.nanmax(self.loading[row]) if reached.size else np.nan
            lost = 100 * (1 - work_out / work_in) if work_in > 0 else np.nan
            lines.append(
                f"{target + 1:<7}{deepest:>6.2f} mm{largest:>8.2f} N{1e3 * work_in:>9.3f} mJ"
                f"{1e3 * work_out:>9.3f} mJ{lost:>6.1f} %"
            )
        return lines


def press_curves(session: Session) -> PressCurves:
    """Return the curves of every target that was pressed and released.

    Forces are those of the stream at full rate, minus the first reference of each run. Depths come
    from the robot's pose, interpolated to the times of the forces.

    Raises:
        SessionError: No such target, or no contact frame to measure depth in.
    """
    if "contact_frame" not in session.attrs:
        raise SessionError(f"{session.path}: no contact_frame, so no depth")
    presses = Presses(session)
    for kind, stream in (("force", presses.force), ("pose", presses.pose)):
        if stream is None:
            raise SessionError(f"{session.path}: no stream of kind {kind}, so no force over depth")
    parts: dict[int, dict[int, tuple[Floats, Floats]]] = {}
    deepest = 0.0
    for phase in presses.phases:
        if phase.code in (DOWN, UP):
            depth, force = _samples(session, phase)
            if len(depth) > 1:
                parts.setdefault(phase.target, {})[phase.code] = (depth, force)
                deepest = max(deepest, float(depth.max()))
    whole = sorted(target for target, ways in parts.items() if len(ways) == 2)
    if not whole or deepest <= 0:
        raise SessionError(f"{session.path}: no target was pressed and released")
    grid = np.linspace(0.0, deepest, _STEPS)
    return PressCurves(
        grid,
        np.array(whole, np.int64),
        np.array([_at(grid, *parts[target][DOWN]) for target in whole]),
        np.array([_at(grid, *parts[target][UP]) for target in whole]),
    )


def save_curves(curves: PressCurves, path: Path, title: str) -> None:
    """Write the curves as a PNG: loading warm, unloading cool, one line per press."""
    lines = []
    for row in range(len(curves.target)):
        names = ("loading", "unloading") if row == 0 else ("", "")
        lines.append(Curve(names[0], curves.loading[row], RED))
        lines.append(Curve(names[1], curves.unloading[row], BLUE))
    picture = line_plot(
        _SIZE, 1e3 * curves.depth, lines, title=f"{title}: compression [N]", x_label="depth [mm]"
    )
    picture.save(path)


def _samples(session: Session, phase: Phase) -> tuple[Floats, Floats]:
    """Return depth (n,) [m] and compression (n,) [N] during one phase."""
    reference = np.flatnonzero(np.asarray(session.reference["run"]) == phase.run)
    zero = float(session.reference["wrench"][reference[0]][2]) if reference.size else 0.0
    depth = phase.depth
    finite = np.isfinite(depth)
    return depth[finite], zero - phase.stored[finite, 2]


def _at(grid: Floats, depth: Floats, force: Floats) -> Floats:
    """Return the mean force around each depth of the grid (m,); NaN if there is no sample."""
    step = grid[1] - grid[0]
    bins = np.round(depth / step).astype(np.int64)
    inside = (bins >= 0) & (bins < len(grid))
    count = np.bincount(bins[inside], minlength=len(grid))
    total = np.bincount(bins[inside], force[inside], minlength=len(grid))
    values = np.full(len(grid), np.nan)
    values[count > 0] = total[count > 0] / count[count > 0]
    # A fast move may leave an empty bin between two filled ones: interpolate it.
    filled = np.flatnonzero(count)
    if filled.size:
        inside = slice(filled[0], filled[-1] + 1)
        values[inside] = np.interp(grid[inside], grid[filled], values[filled])
    return values
