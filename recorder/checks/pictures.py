"""Witnesses of pictures and taxels: dark, turned, exchanged, late, or still in a press."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import simplejpeg
from numpy.typing import NDArray

from recorder.checks.presses import DOWN, Presses
from recorder.checks.testimony import Testimony, most
from recorder.findings import Finding
from recorder.session.align import NS
from recorder.session.columns import Stream

Floats = NDArray[np.floating]

# Part of an image's height and width that is looked at, and images that are held at once.
SMALLER, HELD = 8, 256
# Contrast over the usual one, and in grey levels, below which a picture is dark.
DARK, DARKEST = 0.3, 2.0
# How much better a turned picture agrees with the reference (correlation) than as it is.
TURNED = 0.15
# Difference of a picture from the middle of its neighbours over that of these, and over the noise.
ODD, NOISY = 3.0, 8.0
# Change from one picture to the next over those before and after it, and over the noise.
JUMP, JUMP_NOISY = 5.2, 8.0
# Delay of the pictures behind the force [s], how much better both agree with it (correlation), how
# well at least, and longest delay that is looked for [s].
DELAY, BETTER, AGREE, LONGEST = 0.35, 0.02, 0.5, 1.0
# Change of the picture by a press, over the noise, below which it stands still; and that of the
# other presses from which it would show.
STILL, SHOWS = 1.3, 4.0
# Time after a phase at which its last picture has arrived [s].
LATE = 0.12
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
        if len(stream) < 4 or stream.layout.image is None:
            continue
        looked = _looked(stream, _reference_rows(presses, name))
        for run in range(1, len(session.runs)):  # pictures of two runs are no neighbours
            begin = session.rows_of_run(name, run).start or 0
            looked.change[max(begin - 1, 0) : begin] = 0.0
            looked.odd[max(begin - 2, 0) : begin] = 0.0
        for row, why in looked.broken.items():
            yield Testimony(np.inf, Finding("bad-image", f"streams/{name}", f"row {row}: {why}"))
        for witness in (_dark, _turned, _exchanged, _jumps):
            yield from witness(name, looked)
        if name == session.signal:
            yield from _still(presses, name, looked)
            yield from _late(presses, name, looked)


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """Numbers of n pictures, each an eighth as large, after one look at all of them."""

    contrast: Floats
    """Spread of grey levels (n,)."""
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

    @property
    def noise(self) -> float:
        """Difference from one picture to the next when nothing moves."""
        some = self.change[self.change > 0]
        return float(np.quantile(some, 0.2)) if some.size else 0.0


def _looked(stream: Stream, reference_rows: list[int]) -> Looked:
    broken: dict[int, str] = {}
    reference = smaller(stream, reference_rows, {}).mean(axis=0) if reference_rows else None
    turns = [] if reference is None else [turn(reference) for turn in TURNS.values()]
    parts: dict[str, list[Floats]] = {name: [] for name in Looked.__dataclass_fields__}
    before = np.zeros((0, *_size(stream)), np.float32)
    for first in range(0, len(stream), HELD):
        some = smaller(stream, range(first, min(first + HELD, len(stream))), broken)
        parts["contrast"].append(some.std(axis=(1, 2)))
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
    return Looked(**whole, usual=usual, broken=broken)


def _rms(images: Floats) -> Floats:
    return np.asarray(np.sqrt((images**2).mean(axis=(1, 2))))


def _size(stream: Stream) -> tuple[int, int]:
    image = stream.layout.image
    height, width = (0, 0) if image is None else image.column.shape[:2]
    return height // SMALLER, width // SMALLER


def smaller(stream: Stream, rows: Sequence[int], broken: dict[int, str]) -> Floats:
    """Return pictures of a camera (n, h, w), grey and an eighth as large along each side.

    Rows that cannot be decoded are added to `broken`, and are those before them.
    """
    height, width = _size(stream)
    small = np.zeros((len(rows), height, width), np.float32)
    if stream.jpeg_shape is None:
        some = stream.images(np.asarray(rows))[:, : height * SMALLER, : width * SMALLER]
        shape = len(some), height, SMALLER, width, SMALLER * some.shape[3]
        return np.asarray(some.reshape(shape).mean(axis=(2, 4)), np.float32)
    for k, (row, data) in enumerate(zip(rows, stream.jpegs(rows), strict=True)):
        try:
            image = simplejpeg.decode_jpeg(data, "GRAY", True, True, height, width)
            small[k] = image[:height, :width, 0]
        except ValueError as error:
            broken[row] = f"cannot be decoded: {error}"
            small[k] = small[k - 1]
    return small


def _reference_rows(presses: Presses, name: str) -> list[int]:
    """Return rows of the pictures without contact."""
    column = presses.session.columns.get(name)
    rows = np.asarray(presses.session.reference.get(column, ()) if column else (), np.int64)
    return [int(row) for row in rows if 0 <= row < len(presses.session.streams[name])]


def _agreement(small: Floats, other: Floats | None) -> Floats:
    """Return the correlation of pictures (n, h, w) with another (h, w)."""
    if other is None:
        return np.full(len(small), np.nan)
    flat = small.reshape(len(small), -1) - small.mean(axis=(1, 2))[:, None]
    one = (other - other.mean()).ravel()
    sizes = np.linalg.norm(flat, axis=1) * np.linalg.norm(one)
    return np.asarray(flat @ one / np.maximum(sizes, 1e-9))


def _dark(name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures without contrast: a light that is off, a cover, a cable."""
    contrast = looked.contrast
    yield from most(
        max(DARK * looked.usual, DARKEST) / np.maximum(contrast, 1e-3),
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


def _exchanged(name: str, looked: Looked) -> Iterator[Testimony]:
    """Single pictures that belong elsewhere: their neighbours agree, and they do not."""
    limit = ODD * looked.apart + NOISY * looked.noise
    yield from most(
        looked.odd / np.maximum(limit, 1e-3),
        "odd-image",
        f"streams/{name}",
        lambda k: f"row {k + 1} differs from its neighbours, which are alike: exchanged, or torn",
    )


def _jumps(name: str, looked: Looked) -> Iterator[Testimony]:
    """Pictures that are another one all at once, as when they are turned or of another time."""
    change = looked.change
    before, after = np.append(change[1], change[:-1]), np.append(change[1:], change[-2])
    limit = JUMP * np.maximum(before, after) + JUMP_NOISY * looked.noise
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
    axes = [axis for axis in presses.measured if axis < 3]
    for run in range(max(len(session.runs), 1)):
        rows = session.rows_of_run(name, run)
        moved = looked.moved[rows]
        if force is None or not axes or len(moved) < 30 or np.isnan(moved).any():
            continue
        of_force = session.rows_of_run(force.name, run)
        times = stream.t_ns[rows] * NS - float(stream.attrs.get("latency") or 0.0)
        moments, values = force.t_ns[of_force] * NS, presses.values[of_force]
        size = np.sqrt(sum(values[:, axis] ** 2 for axis in axes))
        order = np.argsort(moments)
        reach = round(LONGEST * stream.rate_hz)
        lags = np.arange(-reach, reach + 1) / stream.rate_hz
        at = [np.interp(times - lag, moments[order], size[order]) for lag in lags]
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
    found = []
    for one in presses.of(DOWN):
        rows = presses.session.rows_of_run(name, one.run)
        times, begin = stream.t_ns[rows], int(rows.start or 0)
        first = int(np.searchsorted(times, one.start))
        last = int(np.searchsorted(times, one.end + round(LATE / NS)))
        if one.whole and first < last < len(times) and noise > 0:
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


# Noise of a taxel's axis over the median of all below which it is dead, and the least such median
# [counts]: a quieter one may not show in whole numbers.
DEAD, QUIET = 0.05, 0.5


def taxels(presses: Presses) -> Iterator[Testimony]:
    """Taxels that always have one value while others change."""
    for name in presses.session.of_kind("taxels"):
        values = np.asarray(presses.session.streams[name].array("value"), np.float64)
        if len(values) >= 10 and values.ndim == 3:
            yield from _dead(name, values)


def _dead(name: str, values: Floats) -> Iterator[Testimony]:
    noise = np.diff(values, axis=0).std(axis=0)
    usual, axes = float(np.median(noise)), values.shape[2]

    def text(k: int) -> str:
        taxel, axis = divmod(k, axes)
        return f"taxel {taxel}, axis {axis} always has about {values[0, taxel, axis]:.6g}"

    if usual > QUIET:
        yield from most(
            DEAD * usual / np.maximum(noise.ravel(), 1e-9), "dead-taxel", f"streams/{name}", text
        )
