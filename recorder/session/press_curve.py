"""Force over depth of a session of straight presses: loading and unloading curve per press."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from recorder.charts import BLUE, RED
from recorder.errors import SessionError
from recorder.plot import Curve, line_plot
from recorder.session import align
from recorder.session.contact_frame import in_frame, surface_heights
from recorder.session.reader import Session
from recorder.spec import PHASES

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
    segments = session.segments
    surface = surface_heights(session)
    presses: dict[int, dict[int, tuple[Floats, Floats]]] = {}
    deepest = 0.0
    for row in range(len(segments["target"])):
        target, phase = int(segments["target"][row]), int(segments["phase"][row])
        if phase in (PHASES.index("normal_inc"), PHASES.index("normal_dec")):
            depth, force = _samples(session, row)
            depth = depth + surface[target]
            if len(depth) > 1:
                presses.setdefault(target, {})[phase] = (depth, force)
                deepest = max(deepest, float(depth.max()))
    whole = sorted(target for target, parts in presses.items() if len(parts) == 2)
    if not whole or deepest <= 0:
        raise SessionError(f"{session.path}: no target was pressed and released")
    grid = np.linspace(0.0, deepest, _STEPS)
    down, up = (PHASES.index(name) for name in ("normal_inc", "normal_dec"))
    return PressCurves(
        grid,
        np.array(whole, np.int64),
        np.array([_at(grid, *presses[target][down]) for target in whole]),
        np.array([_at(grid, *presses[target][up]) for target in whole]),
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


def _samples(session: Session, row: int) -> tuple[Floats, Floats]:
    """Return depth (n,) [m] and compression (n,) [N] during one segment."""
    segments = session.segments
    run = int(segments["run"][row])
    force, pose = (session.streams[name] for name in _force_and_pose(session))
    rows, poses = session.rows_of_run(force.name, run), session.rows_of_run(pose.name, run)
    times = force.t_ns[rows]
    inside = (times >= segments["start_ns"][row]) & (times < segments["end_ns"][row])
    value = np.asarray(force.array("value"))[rows][inside, 2]
    reference = np.flatnonzero(np.asarray(session.reference["run"]) == run)
    zero = float(session.reference["wrench"][reference[0]][2]) if reference.size else 0.0
    frame = np.asarray(session.attrs["contact_frame"], np.float64)
    height = in_frame(frame, np.asarray(pose.array("value"))[poses])[:, 2]
    depth = -align.linear(pose.t_ns[poses], height, times[inside]).value
    finite = np.isfinite(depth)
    return depth[finite], -(value[finite] - zero)


def _force_and_pose(session: Session) -> tuple[str, str]:
    force, pose = session.first("force"), session.first("pose")
    if force is None or pose is None:
        what = "force" if force is None else "pose"
        raise SessionError(f"{session.path}: no stream of kind {what}, so no force over depth")
    return force, pose


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
