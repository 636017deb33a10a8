"""Witnesses of pictures and taxels: dark, turned, exchanged, late, or still in a press."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.checks.testimony import Testimony, most
from recorder.checks.timing import timing
from recorder.findings import Finding
from recorder.session.align import NS, captured
from recorder.session.columns import Stream
from recorder.session.delays import beyond_noise
from recorder.session.presses import DEEP, DOWN, Presses
from recorder.session.small_pictures import FEWEST, reference_rows, small_size, smaller

Floats = NDArray[np.floating]

# Pictures that are held at once, and about their pixels.
HELD, HELD_PIXELS = 256, 1 << 23
# Contrast over the usual one below which a picture is dark; and contrast and mean, in grey levels.
DARK, DARKEST, BLACK = 0.3, 2.0, 30.0
# How much better a turned picture agrees with the reference (correlation) than as it is.
TURNED = 0.15
# Difference of a picture from the middle of its neighbours over that of these, and over the noise.
ODD, NOISY = 3.0, 8.0
# Change from one picture to the next over those before and after it, and over the noise; how much
# more while the force changes; and rate of a camera that sees a fast press between two [Hz].
JUMP, JUMP_NOISY, MORE, SLOW = 7.0, 11.0, 4.0, 20.0
# Delay of the pictures behind the force [s], how much better both agree with it (correlation), how
# well at least, and longest delay that is looked for [s].
DELAY, BETTER, AGREE, LONGEST = 0.35, 0.02, 0.5, 1.0
# Change of the picture by a press, over the noise, below which it stands still; and that of the
# other presses from which it would show.
STILL, SHOWS = 1.3, 4.0
# Time after a phase at which its last picture has arrived [s].
LATE = 0.12
# Way of the picture beside the gel from which something has slipped [px].
SLIPPED = 0.5
# Ways in which pictures are turned.
TURNS: dict[str, Callable[[Floats], Floats]] = {
    "by 180 degrees": lambda image: image[..., ::-1, ::-1],
    "mirrored sideways": lambda image: image[..., ::-1],
    "mirrored upside down": lambda image: image[..., ::-1, :],
}


def pictures(presses: Presses) -> Iterator[Testimony]:
    """Yield the testimonies about the pictures of each camera."""
    session = presses.session
    for name in session.of_kind("camera"):
        stream = session.streams[name]
        if len(stream) < 4 or min(small_size(stream)) < FEWEST:
            continue
        resting = reference_rows(session, name)
        looked = presses.looked[name] = _looked(stream, resting, presses.looked.get(name))
        for run in range(1, len(session.runs)):  # pictures of two runs are no neighbours
            begin = session.rows_of_run(name, run).start or 0
            looked.change[max(begin - 1, 0) : begin] = 0.0
            looked.odd[max(begin - 2, 0) : begin] = 0.0
        yield from _broken(name, looked)
        yield from _dark(name, looked)
        yield from _turned(name, looked)
        yield from _aside(presses, name)
        if stream.rate_hz >= SLOW:
            pushed = _pushed(presses, name)
            yield from _exchanged(name, looked, pushed)
            yield from _jumps(name, looked, pushed)
        if name == session.signal:
            yield from _still(presses, name, looked)
            yield from _late(presses, name, looked)
            yield from timing(presses, stream, beyond_noise(looked.moved))


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """Numbers of n pictures, each an eighth as large, after one look at all of them."""

    contrast: Floats
    """Spread of grey levels (n,)."""
    level: Floats
    """Their mean (n,)."""
    as_is: Floats
    """Correlation with the reference (n,); NaN without one."""
    turned: Floats
    """The same with the reference turned in each of `TURNS` (t, n)."""
    moved: Floats
    """Difference from the reference (n,), in grey levels, as all differences; NaN without one."""
    change: Floats
    """Difference from the next picture (n - 1,)."""
    apart: Floats
    """Difference of both neighbours (n - 2,)."""
    odd: Floats
    """Difference from the middle of both neighbours (n - 2,)."""
    usual: float
    """Contrast of the reference, or of the median picture."""
    broken: dict[int, str]
    """Rows that cannot be decoded, and why."""
    last: Floats
    """The last two pictures."""

    @property
    def noise(self) -> float:
        """Difference from one picture to the next when nothing moves."""
        some = self.change[self.change > 0]
        return float(np.quantile(some, 0.2)) if some.size else 0.0


def _looked(stream: Stream, resting: list[int], begun: Looked | None) -> Looked:
    """Return the numbers of all pictures; `begun` has those of the first ones."""
    size = small_size(stream)
    before = np.zeros((0, *size), np.float32) if begun is None else begun.last
    broken = {} if begun is None else begun.broken
    reference = smaller(stream, resting, {}).mean(axis=0) if resting else None
    turns = [reference if reference is None else turn(reference) for turn in TURNS.values()]
    columns = Looked.__dataclass_fields__.keys() - {"usual", "broken", "last"}
    parts = {name: [] if begun is None else [getattr(begun, name)] for name in columns}
    done = 0 if begun is None else len(begun.contrast)
    held = min(HELD, 4 + HELD_PIXELS // math.prod(size))
    for first in range(done, len(stream), held):
        some = smaller(stream, range(first, min(first + held, len(stream))), broken)
        parts["contrast"].append(some.std(axis=(1, 2)))
        parts["level"].append(some.mean(axis=(1, 2)))
        parts["as_is"].append(_agreement(some, reference))
        parts["turned"].append(np.array([_agreement(some, turn) for turn in turns]))
        beside = np.full(len(some), np.nan) if reference is None else _rms(some - reference)
        parts["moved"].append(beside)
        some = np.concatenate([before, some])
        parts["change"].append(_rms(some[1:] - some[:-1])[max(len(before) - 1, 0) :])
        parts["apart"].append(_rms(some[2:] - some[:-2]))
        parts["odd"].append(_rms(some[1:-1] - 0.5 * (some[2:] + some[:-2])))
        before = some[-2:]
    whole = {name: np.concatenate(part, axis=-1) for name, part in parts.items() if part}
    usual = max(
        float(np.median(whole["contrast"])), 0.0 if reference is None else float(reference.std())
    )
    return Looked(**whole, usual=usual, broken=broken, last=before)


def _rms(images: Floats) -> Floats:
    return np.asarray(np.sqrt((images**2).mean(axis=(1, 2))))


def _agreement(small: Floats, other: Floats | None) -> Floats:
    """Return the correlation of pictures (n, h, w) with another (h, w)."""
    if other is None:
        return np.full(len(small), np.nan)
    flat = small.reshape(len(small), -1) - small.mean(axis=(1, 2))[:, None]
    one = (other - other.mean()).ravel()
    sizes = np.linalg.norm(flat, axis=1) * np.linalg.norm(one)
    return np.asarray(flat @ one / np.maximum(sizes, 1e-9))


def _broken(name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures that cannot be decoded."""
    rows = [f"row {row}: {why}" for row, why in looked.broken.items()]
    yield from most([np.inf] * len(rows), "bad-image", f"streams/{name}", rows.__getitem__)


def _dark(name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures without contrast: a light that is off, a cover, a cable."""
    contrast = looked.contrast
    least = np.maximum(DARK * looked.usual, np.where(looked.level < BLACK, DARKEST, 0.0))
    yield from most(
        least / np.maximum(contrast, 1e-3),
        "dark",
        f"streams/{name}",
        lambda row: (
            f"row {row} has a contrast of {contrast[row]:.3g} grey levels, usual are "
            f"{looked.usual:.3g}: check the light and the exposure"
        ),
    )


def _turned(name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures that agree better with the reference if they are turned."""
    as_is, turned = looked.as_is, looked.turned
    if np.isnan(as_is).all():
        return
    best = turned.max(axis=0)

    def text(row: int) -> str:
        how = list(TURNS)[int(turned[:, row].argmax())]
        return (
            f"row {row} shows the reference {how} (correlation {best[row]:.2f}, {as_is[row]:.2f} "
            "as it is)"
        )

    yield from most((best - as_is) / TURNED, "turned", f"streams/{name}", text)


def _pushed(presses: Presses, name: str) -> Floats:
    """Return how much more than usual a picture may differ from the next (n - 1,)."""
    stream, force, session = presses.session.streams[name], presses.force, presses.session
    pushed = np.ones(max(len(stream) - 1, 0))
    axes = presses.forces
    for run in range(max(len(session.runs), 1)):
        if force is None or not axes:
            break
        rows, of_force = (session.rows_of_run(each, run) for each in (name, force.name))
        if rows.stop - rows.start < 2 or of_force.stop - of_force.start < 2:
            continue
        times, values = force.t_ns[of_force], force.array("value")[of_force]
        # A picture shows the force of up to `LATE` before it arrives.
        at = stream.t_ns[rows]
        first, last = np.searchsorted(times, (at[:-1] - round(LATE / NS), at[1:]))
        last = np.minimum(last, len(times) - 1)
        apart = np.max(
            [np.abs(values[last, k] - values[np.minimum(first, last), k]) for k in axes], 0
        )
        limit = presses.felt(0, 1, 2)
        pushed[rows.start : rows.stop - 1] = np.where(apart > limit, MORE, 1.0)
    return pushed


def _exchanged(name: str, looked: Looked, pushed: Floats) -> Iterator[Testimony]:
    """Single pictures that belong elsewhere: their neighbours agree, and they do not."""
    limit = (ODD * looked.apart + NOISY * looked.noise) * np.maximum(pushed[1:], pushed[:-1])
    yield from most(
        looked.odd / np.maximum(limit, 1e-3),
        "odd-image",
        f"streams/{name}",
        lambda k: f"row {k + 1} differs from its neighbours, which are alike: exchanged, or torn",
    )


def _jumps(name: str, looked: Looked, pushed: Floats) -> Iterator[Testimony]:
    """Pictures that are another one all at once, as when they are turned or of another time."""
    change = looked.change
    before, after = np.append(change[1], change[:-1]), np.append(change[1:], change[-2])
    limit = (JUMP * np.maximum(before, after) + JUMP_NOISY * looked.noise) * pushed
    yield from most(
        change / np.maximum(limit, 1e-3),
        "image-jump",
        f"streams/{name}",
        lambda k: (
            f"the picture changes at once from row {k} to {k + 1}: turned, exchanged, or lit "
            "in another way"
        ),
    )


def _late(presses: Presses, name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures that leave the reference at other times than the force does."""
    force, stream, session = presses.force, presses.session.streams[name], presses.session
    axes = presses.forces
    if force is None or not axes:
        return
    seen_at, felt_at = captured(stream) * NS, captured(force) * NS
    for run in range(max(len(session.runs), 1)):
        rows = session.rows_of_run(name, run)
        moved = looked.moved[rows]
        if len(moved) < 30 or np.isnan(moved).any():
            continue
        of_force = session.rows_of_run(force.name, run)
        if of_force.stop - of_force.start < 2:
            continue
        times, moments = seen_at[rows], felt_at[of_force]
        values = force.array("value")[of_force]
        size = np.sqrt(sum(values[:, axis] ** 2 for axis in axes))
        order = np.argsort(moments, kind="stable")
        moments, size = moments[order], size[order]
        reach = round(LONGEST * stream.rate_hz)
        lags = np.arange(-reach, reach + 1) / stream.rate_hz
        at = (np.interp(times - lag, moments, size) for lag in lags)
        agree = np.nan_to_num([np.corrcoef(moved, one)[0, 1] for one in at], nan=-1.0)
        best = int(agree.argmax())
        better = agree[best] > AGREE and agree[best] - agree[reach] > BETTER
        message = (
            f"the pictures change {1e3 * lags[best]:+.0f} ms after the force (correlation "
            f"{agree[best]:.2f}, {agree[reach]:.2f} at the stored times): check the clocks of both"
        )
        doubt = abs(float(lags[best])) / DELAY if better else 0.0
        yield Testimony(doubt, Finding("image-time", f"streams/{name}", message))


def _still(presses: Presses, name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures that do not change while a press begins, as those of others do."""
    stream, noise = presses.session.streams[name], looked.noise
    axes, found = presses.forces, []
    for one in presses.of(DOWN):
        rows = presses.session.rows_of_run(name, one.run)
        times, begin = stream.t_ns[rows], int(rows.start or 0)
        first = int(np.searchsorted(times, one.start))
        last = int(np.searchsorted(times, one.end + round(LATE / NS)))
        felt = float(np.nanmax(np.linalg.norm(one.wrench[:, :3], axis=1), initial=0.0))
        touched = not axes or felt > presses.felt(0, 1, 2)
        deep = not presses.planned("depth", one.target) < DEEP
        if one.whole and deep and touched and first < last < len(times) and noise > 0:
            both = smaller(stream, [begin + first, begin + last], {})
            found.append((float(_rms(both[1:] - both[:1])[0]) / noise, one.target, begin + first))
    changes = np.array([change for change, _target, _row in found])
    if len(found) and (np.median(changes) > SHOWS or np.median(changes) < STILL):
        yield from most(
            (STILL / np.maximum(changes, 1e-3)) ** 2,
            "still-image",
            f"streams/{name}",
            lambda k: (
                "the picture does not change while target "
                f"{found[k][1] + 1} is pressed, from row {found[k][2]}: it repeats itself"
            ),
        )


def _aside(presses: Presses, name: str) -> Iterator[Testimony]:
    """Pictures before a control press that lie aside of the first one at its point."""
    control = next(iter(presses.session.controls), None)
    if control is None:
        return
    rows = reference_rows(presses.session, name, presses.planned("point", control))
    ways = [_way(presses.session.streams[name], (rows[0], row)) for row in rows[1:]]

    def text(k: int) -> str:
        where = f"row {rows[k + 1]} lies {ways[k]:.2g} px aside of row {rows[0]}"
        return f"{where}, both without contact: slipped mount, torn skin, or drift"

    yield from most(np.array(ways) / SLIPPED, "control", f"streams/{name}", text)


def _way(stream: Stream, rows: tuple[int, int]) -> float:
    """Return how far the first of two pictures is moved in the other [px], in any light."""
    one, other = np.nan_to_num(smaller(stream, rows, {}))
    basis = np.stack([*np.gradient(one), one, np.ones_like(one)], axis=-1).reshape(-1, 4)
    way = np.hypot(*np.linalg.lstsq(basis, other.ravel(), rcond=None)[0][:2])
    return float(way * (stream.value_column or one).shape[0] / len(one))


# Noise of a taxel's axis over that of others at rest below which it is dead, and the least such
# noise [counts]: less may not show in whole numbers. Parts of a recording that are looked at one by
# one, and their least rows; noise at rest is that of the quietest, which a third of taxels exceed.
DEAD, QUIET, PARTS, PART_ROWS, LIVELY = 0.05, 0.5, 10, 20, 0.65


def taxels(presses: Presses) -> Iterator[Testimony]:
    """Taxels that always have one value while others change."""
    for name in presses.session.of_kind("taxels"):
        values = np.asarray(presses.session.streams[name].array("value"), np.float64)
        if len(values) >= 10 and values.ndim == 3:
            yield from _dead(name, values)
            yield from _late_taxels(presses, name, values)


def _late_taxels(presses: Presses, name: str, values: Floats) -> Iterator[Testimony]:
    session = presses.session
    rest = np.asarray(session.reference.get(session.columns.get(name, ""), ()), np.float64)
    if rest.shape[1:] == values.shape[1:] and len(rest):
        moved = np.sqrt(np.square(values - np.nanmean(rest, axis=0)).mean(axis=(1, 2)))
        yield from timing(presses, session.streams[name], beyond_noise(moved))


def _dead(name: str, values: Floats) -> Iterator[Testimony]:
    parts = [part for part in np.array_split(values, PARTS) if len(part) >= PART_ROWS] or [values]
    noise = np.array([np.diff(part, axis=0).std(axis=0) for part in parts])
    usual = np.quantile(noise.min(axis=0), LIVELY, axis=0)  # (axes,)
    known = np.flatnonzero(usual > QUIET)
    doubt = DEAD * usual[known] / np.maximum(noise[..., known], 1e-9)

    def text(k: int) -> str:
        part, taxel, axis = np.unravel_index(k, doubt.shape)
        always = f"always has about {parts[part][0, taxel, known[axis]]:.6g}"
        return f"taxel {taxel}, axis {known[axis]} {always} in part {part + 1} of {len(parts)}"

    yield from most(doubt.ravel(), "dead-taxel", f"streams/{name}", text)
