"""Lag, drift and one step between the clocks of pictures and of forces.

The force along its main direction is fitted by what pictures show of it, at the lag that leaves
least: their principal components, and past means of the first, as gel creeps behind a force. Parts
of a recording give the uncertainty, and have to agree.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from recorder.convert.import_presses import Signal
from recorder.convert.import_tracks import Floats, MissingAnswer, Times
from recorder.session.align import NS

# Largest lag at the start, in seconds and as part of the time; largest drift; resolution of the
# search [s], and pictures that it looks at.
_LAG_MOST, _LAG_PART, _DRIFT_MOST, _RESOLUTION, _SEARCHED = 1.0, 0.4, 0.02, 0.02, 800
# Principal components of a picture, and times over which its past means are taken [s].
_COMPONENTS, _PAST = 3, (0.2, 1.0)
# Least correlation; least that another lag leaves, over the best one; most that a step leaves, over
# none; part of the time and seconds over which contacts show a drift; pictures that are needed.
_CORRELATED, _RIVAL, _STEPPED, _SPAN, _SPAN_S, _FEWEST = 0.7, 1.3, 0.3, 0.3, 4.0, 30
# Parts for the uncertainty, and for agreement; least part of the force's changes in a third.
_PARTS, _AGREE, _TELLS = 18, 6, 0.02
# Least standard uncertainty, that without a drift, largest, and most by which parts may differ, in
# periods of pictures.
_FLOOR, _FLOOR_NEAR, _WIDEST, _APART = 0.15, 0.35, 0.5, 1.0
# Names of what cannot be tested where too little happens.
_THIRDS, DRIFT = ("the first third", "the middle third", "the last third"), "drift"


class Untestable(MissingAnswer):
    """Raised where nothing in a recording tells the lag."""


@dataclass(frozen=True, slots=True, eq=False)
class ClockFit:
    """Delay of pictures or taxels behind the force."""

    t: Floats
    """Times of the pictures (n,) on their clock [s]."""
    lag: Floats
    """Delay of each (n,) [s]."""
    drift: float
    """Seconds that the pictures' clock gains in one."""
    step: str
    """Message on a step of the delay; or empty."""
    sigma: float
    """Standard uncertainty of the delay, where it is largest [s]."""
    correlation: float
    untested: tuple[str, ...]
    """Thirds of the recording, and drift, that cannot be tested as too little happens."""

    def moved(self, t_ns: Times) -> Times:
        """Return times (n,) of the pictures' clock on that of the force [ns]."""
        return np.asarray(t_ns - np.round(np.interp(t_ns * NS, self.t, self.lag) / NS), np.int64)

    def __str__(self) -> str:
        low, high = (1e3 * (self.lag[0] + sign * 1.96 * self.sigma) for sign in (-1, 1))
        text = f"{1e3 * self.lag[0]:+.0f} ms (95 %: {low:+.0f} to {high:+.0f} ms)"
        if self.drift:
            text += f" at the start, growing by {100 * self.drift:+.3f} % of the time"
        text += f"{self.step}, correlation {self.correlation:.2f}"
        return text + f"; not testable: {', '.join(self.untested)}" * bool(self.untested)


def find_clock(sensed: Signal, force: Signal, where: str) -> ClockFit:
    """Return how much later pictures or taxels show contacts than the force does.

    Raises:
        Untestable: Nothing tells the lag, or many lags explain the force as well.
        MissingAnswer: Parts of the recording disagree.
    """

    def refused(why: str, kind: type[MissingAnswer] = Untestable) -> MissingAnswer:
        text = f"{where}: the lag of {sensed.name} behind {force.name} cannot be found: {why}"
        return kind("lag", text, ("SECONDS", "0 if they started together"))

    if (fewest := min(len(sensed.t_ns), len(force.t_ns))) < _FEWEST:
        raise refused(f"{fewest} samples are too few")
    if (shortest := NS * min(np.ptp(sensed.t_ns), np.ptp(force.t_ns))) < 1.0:
        raise refused(f"{shortest:.3g} s are too short")
    if not np.ptp(force.rows) > 0 or not np.ptp(sensed.rows) > 0:
        raise refused("one of them is flat")
    pair = _Pair(sensed, force)
    t, span, one = pair.t, float(np.ptp(pair.t)), np.ones((len(pair.t), 1))
    start, rival = pair.searched()
    fit = pair.refined(start, np.c_[one, t - t.mean()])
    changes = np.cumsum(np.interp(t - fit.lag, pair.at, pair.slope) ** 2)
    low, high = np.interp([0.05 * changes[-1], 0.95 * changes[-1]], changes, t)
    testable = high - low >= max(_SPAN * span, _SPAN_S)
    drift, step = float(fit.change[1]), ""
    if not testable or abs(drift) * span < _FLOOR * pair.period:
        fit, drift = pair.refined([float(fit.lag[len(t) // 2])], one), 0.0
    if testable:
        stepped, at = pair.stepped(np.c_[one, t - t.mean()] if drift else one)
        if stepped.unexplained < _STEPPED * fit.unexplained:
            fit, rival, drift = stepped, np.inf, float(stepped.change[1]) if drift else 0.0
            step = f", a step of {1e3 * fit.change[-1]:+.0f} ms at {t[at]:.2f} s"
    correlation = float(np.sqrt(max(1 - fit.unexplained, 0)))
    if correlation < _CORRELATED or rival < _RIVAL:
        raise refused(f"they correlate by {correlation:.2f}, and at other lags too")
    if testable and np.abs(fit.parts).max() > _APART * pair.period:
        raise refused(f"parts of it differ by {1e3 * np.ptp(fit.parts):.0f} ms", MissingAnswer)
    if fit.sigma > _WIDEST * pair.period:
        raise refused(f"it is known to ± {1.96e3 * fit.sigma:.0f} ms (95 %) only")
    thirds = np.diff(np.interp(np.linspace(t[0], t[-1], 4), t, changes)) / changes[-1]
    untested = [name for name, each in zip(_THIRDS, thirds, strict=True) if each < _TELLS]
    untested += [] if testable else [DRIFT]
    sigma = float(np.hypot(fit.sigma, (_FLOOR if testable else _FLOOR_NEAR) * pair.period))
    return ClockFit(t, fit.lag, drift, step, sigma, correlation, tuple(untested))


class _Fit(NamedTuple):
    """A fitted delay of each picture (n,), its coefficients (k,), and how well it fits."""

    lag: Floats
    change: Floats
    unexplained: float
    sigma: float
    """Standard uncertainty of the lag where it is largest, by the parts of the recording [s]."""
    parts: Floats
    """Difference of the lag in larger parts that tell it [s]."""


class _Pair:
    """Pictures and forces that are compared."""

    def __init__(self, sensed: Signal, force: Signal) -> None:
        self.t: Floats = np.asarray(sensed.t_ns * NS)
        at = force.t_ns * NS
        self.some = np.arange(0, len(self.t), max(1, len(self.t) // _SEARCHED))
        most = min(_LAG_MOST, _LAG_PART * float(np.ptp(self.t)))
        self.lags = np.arange(-most, most + _RESOLUTION / 2, _RESOLUTION)
        self.period = float(np.median(np.diff(self.t)))
        self.at = np.arange(at[0], at[-1], self.period / 8)
        window = np.hanning(17)
        pressing = np.pad(np.interp(self.at, at, _components(force.rows, 1)[:, 0]), 8, mode="edge")
        self.force = np.convolve(pressing, window / window.sum(), mode="valid")
        self.slope = np.gradient(self.force, self.at)
        first, *others = _components(sensed.rows, _COMPONENTS).T
        self.shown = np.stack([np.ones(len(first)), first, *others, first**2, first**3], axis=1)
        total = np.cumsum(first * np.diff(self.t, prepend=self.t[0]))
        past = [(total - np.interp(self.t - each, self.t, total)) / each for each in _PAST]
        self.crept = np.column_stack([self.shown, *past])

    def left(self, some: NDArray[np.intp], lags: Floats) -> Floats:
        """Return squares that m pictures leave of the force at lags (k, m or 1), and all (2, k)."""
        force = np.interp(self.t[some] - lags, self.at, self.force)
        force -= force.mean(axis=1, keepdims=True)
        power = np.maximum((force**2).sum(axis=1), 1e-9)
        basis = np.linalg.qr(self.shown[some])[0]
        return np.stack([power - ((force @ basis) ** 2).sum(axis=1), power])

    def searched(self) -> tuple[Floats, float]:
        """Return the best middle lag and drift, and the misfit of another lag over theirs."""
        span = float(np.ptp(self.t))
        reach = int(np.ceil(_DRIFT_MOST * span / (2 * _RESOLUTION)))
        drifts = np.linspace(-_DRIFT_MOST, _DRIFT_MOST, 2 * reach + 1)[:, None]
        way = self.t[self.some] - self.t[0]
        left = [self.left(self.some, self.lags[:, None] + each * way) for each in drifts]
        parts = np.array([squares / power for squares, power in left])
        middle = self.lags + drifts * span / 2
        best = np.unravel_index(int(parts.argmin()), parts.shape)
        rival = parts[np.abs(middle - middle[best]) > 10 * _RESOLUTION].min() / parts[best]
        return np.array([middle[best], drifts[best[0], 0]]), float(rival)

    def refined(self, start: Any, basis: Floats) -> _Fit:
        """Return the fit that leaves least near some coefficients (k,) of a basis (n, k)."""
        change = np.asarray(start, np.float64)
        for _ in range(15):  # Gauss-Newton
            at = self.t - basis @ change
            some = np.flatnonzero((at >= self.at[0]) & (at <= self.at[-1]))
            some = some if len(some) >= _FEWEST else np.arange(len(at))
            shown = np.linalg.qr(self.crept[some])[0]
            force = np.interp(at[some], self.at, self.force)
            slope = np.interp(at[some], self.at, self.slope)[:, None] * basis[some]
            residual, slope = (each - shown @ (shown.T @ each) for each in (force, slope))
            change = change + np.linalg.lstsq(slope, residual, rcond=None)[0]
        unexplained = float(residual @ residual / max(len(some) * force.var(), 1e-9))
        ends = np.linspace(self.t[0], self.t[-1], _PARTS + 1)[1:-1]
        rows = np.split(np.arange(len(some)), self.t[some].searchsorted(ends))
        pull = np.array([slope[each].T @ residual[each] for each in rows])
        known = np.array([(slope[each, 0] ** 2).sum() for each in rows])
        inverse = np.linalg.pinv(slope.T @ slope)
        active = int((known > 0.1 * known.mean()).sum())
        spread = inverse @ (pull.T @ pull) @ inverse * active / max(active - len(inverse), 1)
        sigma = np.sqrt(np.einsum("ij,jk,ik->i", basis, spread, basis).max())
        known, pull = (each.reshape(_AGREE, -1).sum(axis=1) for each in (known, pull[:, 0]))
        tells = known > 0.5 * known.mean()
        return _Fit(basis @ change, change, unexplained, float(sigma), pull[tells] / known[tells])

    def stepped(self, basis: Floats) -> tuple[_Fit, int]:
        """Return the fit with a step of the lag as another column, and the picture behind it."""
        count, some, halves = len(self.t), self.some, []
        for at in np.linspace(0, count, _PARTS + 1)[3:-3]:
            sides = np.split(some, [some.searchsorted(at)])
            left = [self.left(each, self.lags[:, None])[0] for each in sides]
            halves.append((sum(map(min, left)), *(self.lags[each.argmin()] for each in left)))
        _, early, late = (np.full(count, each) for each in min(halves))
        ends = some[len(some) // 8 : -len(some) // 8]
        for _ in range(3):
            lags = np.where(some < ends[:, None], early[some], late[some])
            at = int(ends[self.left(some, lags)[0].argmin()])
            later = np.arange(count) >= at
            start = [early.mean(), *np.zeros(basis.shape[1] - 1), (late - early).mean()]
            fit = self.refined(start, np.c_[basis, later])
            early = fit.lag - later * fit.change[-1]
            late = early + fit.change[-1]
        return fit, at


def _components(rows: NDArray[Any], count: int) -> Floats:
    """Return the principal components of rows (n, m), of unit size (n, at most `count`)."""
    centred = np.asarray(rows - rows.mean(axis=0), np.float64)
    found = centred @ np.linalg.eigh(centred.T @ centred)[1][:, ::-1][:, :count]
    return np.asarray(found / np.maximum(found.std(axis=0), 1e-9))
