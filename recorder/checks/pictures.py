"""Witnesses of pictures and taxels: dark, turned, exchanged, late, or still in a press."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from recorder.checks.directions import sheared, taxel_order
from recorder.checks.testimony import Testimony, most, worst
from recorder.checks.timing import timing
from recorder.findings import Finding
from recorder.session.align import NS, captured
from recorder.session.columns import Stream
from recorder.session.delays import beyond_noise
from recorder.session.presses import PRESSED, Presses
from recorder.session.small_pictures import FEWEST, reference_rows, rms, small_size, smaller
from recorder.spec import LATE

Floats = NDArray[np.floating]

# Pictures that are held at once, and about their pixels.
HELD, HELD_PIXELS = 256, 1 << 21
# Contrast over the usual one below which a picture is dark; and its brightest places, about twice
# the contrast above the mean [grey levels]: an eighth of the range.
DARK, DIM = 0.3, 32.0
# How much better a turned picture agrees with the reference (correlation) than as it is, and size
# of each of its maps, as `Looked.agrees` has them, in grey levels, from which that shows.
TURNED, VARIED = 0.15, np.array([0.0, 2.0, 2.0, 6.0])
# Difference of a picture from the middle of its neighbours over that of these, and over the noise.
ODD, NOISY = 3.0, 8.0
# Change from one picture to the next over those before and after it, and over the noise; how much
# more while the force changes; and rate of a camera that sees a fast press between two [Hz].
JUMP, JUMP_NOISY, MORE, SLOW = 7.0, 11.0, 4.0, 20.0
# Delay of the pictures behind the force [s], how much better both agree with it (correlation), how
# well at least, and longest delay that is looked for [s].
DELAY, BETTER, AGREE, LONGEST = 0.35, 0.02, 0.5, 1.0
# Change of the picture, over the noise, below which it stands still; that of others from which it
# would show; time in which it changes [s], and the way of the tip in the skin in it [m].
STILL, SHOWS, HALT, HALT_WAY = 1.3, 4.0, 0.35, 0.4e-3
# Way of the picture beside the gel from which something has slipped [px].
SLIPPED = 0.5
EXCHANGED = np.array([1, -1, 1], np.float32)[:, None, None]
# Ways in which the maps of pictures (3, h, w) are turned.
TURNS: dict[str, Callable[[Floats], Floats]] = {
    "by 180 degrees": lambda maps: maps[..., ::-1, ::-1],
    "mirrored sideways": lambda maps: maps[..., ::-1],
    "mirrored upside down": lambda maps: maps[..., ::-1, :],
    "with red and blue exchanged": lambda maps: maps * EXCHANGED,
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
        bad = [(np.inf, f"row {row}: {why}") for row, why in looked.broken.items()]
        yield from worst(bad, "bad-image", f"streams/{name}")
        yield from _dark(name, looked)
        yield from _turned(name, looked)
        yield from _aside(presses, name)
        if stream.rate_hz >= SLOW:
            pushed = _pushed(presses, name)
            yield from _exchanged(name, looked, pushed)
            yield from _jumps(name, looked.change, looked.noise, pushed)
        if name == session.signal:
            yield from _still(presses, name, looked)
            yield from sheared(presses, stream, looked.flow)
            yield from _late(presses, name, looked)
            yield from timing(presses, stream, beyond_noise(looked.moved))


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """Numbers of n pictures, each an eighth as large, after one look at all of them."""

    contrast: Floats
    """Spread of grey levels (n,)."""
    level: Floats
    """Their mean (n,)."""
    agrees: Floats
    """Correlation with the reference as it is, and in each of `TURNS` (1 + t, 4, n): by `MAPS` less
    their means, and red less blue with it; NaN without one, or if it is less than `VARIED`."""
    moved: Floats
    """Difference from the reference (n,), in grey levels, as all differences; NaN without one."""
    change: Floats
    """Difference from the next picture (n - 1,)."""
    flow: NDArray[np.complexfloating]
    """Motion to the next picture (n - 1,): to the right, and upwards as its imaginary part [px]."""
    later: Floats
    """Difference from the picture after `HALT` (n - m,)."""
    apart: Floats
    """Difference of both neighbours (n - 2,)."""
    odd: Floats
    """Difference from the middle of both neighbours (n - 2,)."""
    usual: float
    """Contrast of the reference, or of the median picture."""
    broken: dict[int, str]
    """Rows that cannot be decoded, and why."""
    last: Floats
    """The last pictures, grey: those of `HALT`, and two at least (m, h, w)."""

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
    reference = np.full((3, *size), np.nan, np.float32)
    if resting:
        some = smaller(stream, resting, {})
        # Colours of the first: the mean of some that are exchanged has none.
        reference = np.stack([some[0].mean(axis=0), *some[1:, 0]])
    references = np.stack([reference, *(turn(reference) for turn in TURNS.values())], axis=1)
    columns = Looked.__dataclass_fields__.keys() - {"usual", "broken", "last"}
    parts = {name: [] if begun is None else [getattr(begun, name)] for name in columns}
    ahead = max(2, round(HALT * stream.rate_hz))
    done = 0 if begun is None else len(begun.contrast)
    held = min(HELD, 4 + HELD_PIXELS // math.prod(size))
    for first in range(done, len(stream), held):
        maps = smaller(stream, range(first, min(first + held, len(stream))), broken)
        some = maps[0]
        parts["contrast"].append(some.std(axis=(1, 2)))
        parts["level"].append(some.mean(axis=(1, 2)))
        parts["agrees"].append(_agreement(maps, references))
        parts["moved"].append(rms(some - reference[0]))
        every = np.concatenate([before, some])
        parts["later"].append(rms(every[ahead:] - every[:-ahead]))
        steps, some = (every[max(len(before) - near, 0) :] for near in (1, 2))
        parts["change"].append(rms(steps[1:] - steps[:-1]))
        parts["flow"].append(_flow(steps))
        parts["apart"].append(rms(some[2:] - some[:-2]))
        parts["odd"].append(rms(some[1:-1] - 0.5 * (some[2:] + some[:-2])))
        before = every[-ahead:]
    whole = {name: np.concatenate(part, axis=-1) for name, part in parts.items() if part}
    usual = float(np.fmax(np.median(whole["contrast"]), reference[0].std()))
    return Looked(**whole, usual=usual, broken=broken, last=before)


def _flow(images: Floats) -> NDArray[np.complexfloating]:
    """Return the motion from each picture (n, h, w) to the next (n - 1,), by least squares."""
    twice, less = images[1:] + images[:-1], (images[:-1] - images[1:])[:, 1:-1, 1:-1]
    right = 0.25 * (twice[:, 1:-1, 2:] - twice[:, 1:-1, :-2])
    down = 0.25 * (twice[:, 2:, 1:-1] - twice[:, :-2, 1:-1])
    pairs = (right, right), (right, down), (down, down), (right, less), (down, less)
    a, b, c, along, below = (np.einsum("nij,nij->n", *pair) for pair in pairs)
    flow = c * along - b * below - 1j * (a * below - b * along)
    return np.asarray(flow / np.maximum(a * c - b * b, 1e-9))


def _agreement(maps: Floats, references: Floats) -> Floats:
    """Return how pictures (3, n, h, w) agree with some (3, t, h, w), as `Looked.agrees`."""
    flat, other = (
        np.concatenate([each - each.mean(axis=(2, 3), keepdims=True), each[1:2]]).reshape(
            4, each.shape[1], -1
        )
        for each in (maps, references)
    )
    sizes = np.linalg.norm(other, axis=2)
    other[sizes[:, 0] < VARIED * flat.shape[2] ** 0.5] = np.nan
    found = flat @ other.swapaxes(1, 2) / np.maximum(np.linalg.norm(flat, axis=2)[..., None], 1e-9)
    return np.asarray((found / sizes[:, None]).transpose(2, 0, 1))


def _dark(name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures without contrast: a light that is off, a cover, a cable."""
    contrast, level = np.maximum(looked.contrast, 1e-3), looked.level
    doubt = np.maximum(DARK * looked.usual / contrast, DIM / (level + 2 * contrast))
    text = f"{{:.3g}} grey levels about {{:.3g}}, usual are {looked.usual:.3g}: check the light"
    words = ("row {} has a contrast of " + text).format
    yield from most(doubt, "dark", f"streams/{name}", lambda k: words(k, contrast[k], level[k]))


def _turned(name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures that agree better with the reference if they are turned, or have other colours."""
    agrees = looked.agrees.reshape(len(looked.agrees), -1)
    best, as_is = agrees[1:].max(axis=0), agrees[0]

    def text(k: int) -> str:
        how = list(TURNS)[int(agrees[1:, k].argmax())]
        agree = f"(correlation {best[k]:.2f}, {as_is[k]:.2f} as it is)"
        return f"row {k % len(looked.level)} shows the reference {how} {agree}"

    if not np.isnan(as_is).all():
        yield from most((best - as_is) / TURNED, "turned", f"streams/{name}", text)


def _pushed(presses: Presses, name: str) -> Floats:
    """Return how much more than usual a picture may differ from the next (n - 1,)."""
    stream, session = presses.session.streams[name], presses.session
    # Objects in a hand move at once, by its fingers or by people.
    usual = MORE if session.of_kind("gripper") else 1.0
    pushed = np.full(max(len(stream) - 1, 0), usual)
    for run in range(max(len(session.runs), 1)):
        rows, (times, forces) = session.rows_of_run(name, run), presses.forces_of(run)
        if rows.stop - rows.start > 1 and forces.size:
            # A picture shows the force of up to `LATE` before it arrives.
            at = stream.t_ns[rows]
            ends = np.searchsorted(times, (at[:-1] - round(LATE / NS), at[1:]))
            first, last = forces[np.minimum(ends, len(times) - 1)]
            apart = np.abs(last - first).max(axis=1)
            pushed[rows.start : rows.stop - 1] += (MORE - 1) * (apart > presses.felt(0, 1, 2))
    return pushed


def _exchanged(name: str, looked: Looked, pushed: Floats) -> Iterator[Testimony]:
    """Single pictures that belong elsewhere: their neighbours agree, and they do not."""
    limit = (ODD * looked.apart + NOISY * looked.noise) * np.maximum(pushed[1:], pushed[:-1])
    doubt, words = looked.odd / np.maximum(limit, 1e-3), "which are alike: exchanged, or torn"
    text = f"row {{}} differs from its neighbours, {words}".format
    yield from most(doubt, "odd-image", f"streams/{name}", lambda k: text(k + 1))


def _jumps(name: str, change: Floats, noise: float, pushed: Floats) -> Iterator[Testimony]:
    """Rows that are another one all at once, as when they are turned or of another time."""
    before, after = np.append(change[1], change[:-1]), np.append(change[1:], change[-2])
    limit = (JUMP * np.maximum(before, after) + JUMP_NOISY * noise) * pushed
    doubt, words = change / np.maximum(limit, 1e-3), "turned, exchanged, or lit in another way"
    text = f"it changes at once from row {{}} to {{}}: {words}".format
    yield from most(doubt, "image-jump", f"streams/{name}", lambda k: text(k, k + 1))


def _late(presses: Presses, name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures that leave the reference at other times than the force does."""
    stream, session = presses.session.streams[name], presses.session
    seen_at, reach = captured(stream) * NS, round(LONGEST * stream.rate_hz)
    lags = np.arange(-reach, reach + 1) / stream.rate_hz
    for run in range(max(len(session.runs), 1)):
        rows, (moments, forces) = session.rows_of_run(name, run), presses.forces_of(run)
        moved = looked.moved[rows]
        if len(moved) < 30 or np.isnan(moved).any() or not forces.size:
            continue
        times, size = seen_at[rows], np.linalg.norm(forces, axis=1)
        at = (np.interp(times - lag, moments * NS, size) for lag in lags)
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
    """Pictures that do not change while the tip moves in the skin, as others do."""
    stream, ahead = presses.session.streams[name], len(looked.level) - len(looked.later)
    found: list[int] = []
    for one in presses.phases:
        rows = presses.rows(stream, one.run, one.start, one.end)
        at, ways = np.arange(rows.start, min(rows.stop, len(looked.later))), []
        felt = np.nanmax(np.linalg.norm(one.wrench[:, presses.forces], axis=1), initial=0.0)
        if presses.forces and felt < presses.felt(0, 1, 2):
            continue
        # A picture shows the skin of up to `LATE` before; reported places may jitter.
        for late in np.linspace(0, LATE / NS, 7).astype(np.int64):
            first, last = (presses.place(one.run, stream.t_ns[at + k] - late) for k in (0, ahead))
            depths = np.maximum(presses.height(one.target) - np.stack([first, last])[..., 2], 0.0)
            pressed = depths.min(axis=0) > PRESSED * presses.planned("depth", one.target)
            aside = np.linalg.norm(last[:, :2] - first[:, :2], axis=1)
            ways.append(np.abs(depths[1] - depths[0]) + pressed * aside)
        found += at[np.min(ways, axis=0) > HALT_WAY].tolist()
    if np.mean(looked.change > 0) > 0.9:  # with noise, no two pictures come again
        again = looked.later == 0
        found += np.flatnonzero(again[1:] & again[:-1]).tolist()
    changes = looked.later[found] / looked.noise
    if len(found) and (np.median(changes) > SHOWS or np.median(changes) < STILL):
        doubt = (STILL / np.maximum(changes, 1e-3)) ** 2
        text = f"the picture does not change for {HALT:g} s from row {{}}: it repeats itself".format
        yield from most(doubt, "still-image", f"streams/{name}", lambda k: text(found[k]))


def _aside(presses: Presses, name: str) -> Iterator[Testimony]:
    """Pictures before a control press that lie aside of the first one at its point."""
    control = next(iter(presses.session.controls), None)
    if control is None:
        return
    rows = reference_rows(presses.session, name, presses.planned("point", control))
    found = []
    for row in rows[1:]:
        way = _way(presses.session.streams[name], (rows[0], row))
        text = f"row {row} lies {way:.2g} px aside of row {rows[0]}, both without contact: "
        found.append((way / SLIPPED, f"{text}slipped mount, torn skin, or drift"))
    yield from worst(found, "control", f"streams/{name}")


def _way(stream: Stream, rows: tuple[int, int]) -> float:
    """Return how far the first of two pictures is moved in the other [px], in any light."""
    one, other = np.nan_to_num(smaller(stream, rows, {})[0])
    basis = np.stack([*np.gradient(one), one, np.ones_like(one)], axis=-1).reshape(-1, 4)
    way = np.hypot(*np.linalg.lstsq(basis, other.ravel(), rcond=None)[0][:2])
    return float(way * (stream.value_column or one).shape[0] / len(one))


# Noise of a taxel's axis over that of others at rest below which it is dead, and the least such
# noise [counts]: less may not show in whole numbers. Time of a part that is looked at alone [s],
# and its least rows; noise at rest is that of the quietest part, which a third of taxels exceed.
DEAD, QUIET, PART, PART_ROWS, LIVELY = 0.2, 1.5, 0.35, 20, 0.65


def taxels(presses: Presses) -> Iterator[Testimony]:
    """Taxels that always have one value while others change."""
    for name in presses.session.of_kind("taxels"):
        stream = presses.session.streams[name]
        values = np.asarray(stream.array("value"), np.float64)
        if len(values) >= 10 and values.ndim == 3:
            yield from _dead(name, values, stream.rate_hz)
            if name == presses.session.signal and values.shape[2] == 3:
                sides = (values[..., 0] + 1j * values[..., 1]).sum(axis=1)
                yield from sheared(presses, stream, np.diff(sides))
                yield from taxel_order(presses, stream, values)
            hand = presses.session.of_kind("gripper")  # steps within one sample
            if presses.forces and stream.rate_hz >= SLOW and not hand:
                change = np.sqrt(np.square(np.diff(values, axis=0)).mean(axis=(1, 2)))
                noise, late = float(np.quantile(change, 0.2)), np.diff(stream.t_ns) * NS
                yield from _jumps(name, change, noise, np.maximum(late * stream.rate_hz, 1.0))
            column = presses.session.columns.get(name, "")
            rest = np.asarray(presses.session.reference.get(column, ()), np.float64)
            if rest.shape[1:] == values.shape[1:] and len(rest):
                moved = np.sqrt(np.square(values - np.nanmean(rest, axis=0)).mean(axis=(1, 2)))
                yield from timing(presses, stream, beyond_noise(moved))


def _dead(name: str, values: Floats, rate_hz: float) -> Iterator[Testimony]:
    parts = np.array_split(values, max(1, len(values) // max(PART_ROWS, round(PART * rate_hz))))
    noise = np.array([np.diff(part, axis=0).std(axis=0) for part in parts])
    usual = np.quantile(noise.min(axis=0), LIVELY, axis=0)  # (axes,)
    known = np.flatnonzero(usual > QUIET)
    doubt = DEAD * usual[known] / np.maximum(noise[..., known], 1e-9)

    def text(k: int) -> str:
        part, taxel, axis = np.unravel_index(k, doubt.shape)
        always = f"always has about {parts[part][0, taxel, known[axis]]:.6g}"
        return f"taxel {taxel}, axis {known[axis]} {always} in part {part + 1} of {len(parts)}"

    yield from most(doubt.ravel(), "dead-taxel", f"streams/{name}", text)
