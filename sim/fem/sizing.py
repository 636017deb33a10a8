"""Element sizes of a mesh, proportional to the width of each contact.

A contact is estimated before the solve, by a linear layer on a window of the contact's size
(milliseconds), and again from the solution. The touching pixels form connected pieces. Within a
piece, the size of elements is a fraction of its width; they grow outwards and downwards from there.
So neither the body's size nor its thickness decides how finely a contact is resolved.

Lengths in metres, in the contact frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.integrate import cumulative_trapezoid

from sim.arrays import Array
from sim.indenters import Indenter
from sim.result import half_widths, pixel_edges
from sim.scene import Body, Scene

Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]

# Elements from one side of a contact to the other, at fineness 1.
ACROSS = 12
# Height of the topmost elements over the shortest side of those in contact.
OVER_DEPTH = 0.6
# Increase of element length over the fine ones, per distance from them: in plan, in depth.
GROWTH, GROWTH_DOWN = 0.3, 0.18
# Longest element under a contact, in thicknesses: a wide contact on a thin layer is resolved like
# the layer's own edge effect, which is about as wide as the layer is thick.
LAYER_SHARE = 0.25
# Height of the tallest element, in thicknesses.
DEEPEST = 1 / 3
# Least cosine between an axis and the outline's normal that counts: an outline along an axis needs
# no refinement along it.
OBLIQUE = 0.2
# Size at the outline of a contact over the smallest radius of the indenter's surface, which may
# bound it; and its minimum over the size within. The force of a punch is 4 % too large if elements
# are as long as the radius of its edge.
EDGE_SHARE, EDGE_LEAST = 0.35, 0.25
# Length of a run of touched pixels, in widths of its piece, above which its middle is coarser.
LONG = 3.0
# Pixels around a piece of a contact that are looked at with it: its outline's normals and the rim
# of the body depend on the next one.
ASIDE = 2
# Standard deviation of the smoothing of masks before normals are taken [pixels].
SMOOTH = 1.5
# Neighbours of a pixel (F, X, Y): those of the same frame.
BESIDE = np.zeros((3, 3, 3), bool)
BESIDE[1] = True
# Points along an axis at which sizes are evaluated; the contacts add about as many.
SITES = 2001


class Span(NamedTuple):
    """Elements no longer than `size` from `low` to `high` along one axis."""

    low: float
    high: float
    size: float


@dataclass(frozen=True, slots=True)
class Sizes:
    """Element sizes that the contacts of a motion require."""

    x: tuple[Span, ...]
    y: tuple[Span, ...]
    top: float
    """Height of the topmost elements; inf if nothing touches."""
    width: float = 0.0
    """Width of the widest piece of a contact, 0 if nothing touches."""

    def joined(self, other: Sizes) -> Sizes:
        """Return sizes that satisfy both."""
        top, width = min(self.top, other.top), max(self.width, other.width)
        return Sizes(self.x + other.x, self.y + other.y, top, width)


NOTHING = Sizes((), (), math.inf)


def sizes_of(
    touched: Mask,
    x: Array,
    y: Array,
    thickness: float,
    edge_radius: float = math.inf,
    on_body: Mask | None = None,
) -> Sizes:
    """Return the element sizes that one contact requires.

    Pixels or nodes (X, Y) that touch are at x (X,), y (Y,), rising, evenly spaced or not; of pixels
    only those `on_body` count. `edge_radius`, the smallest radius of the indenter's surface, may
    bound the contact.
    """
    if not touched.any():
        return NOTHING
    pieces = _pieces_of(touched[None], x, y, thickness, edge_radius, on_body)
    x_spans, y_spans = (
        _least([Span(*row) for row in table[:, 1:].tolist()]) for table in pieces.spans
    )
    return Sizes(x_spans, y_spans, float(pieces.top.min()), float(pieces.width.max()))


# Most pixels of masks that are made together.
PIXELS_MOST = 500_000


class _Pieces(NamedTuple):
    """P pieces of the contacts of frames, and the element sizes that they require."""

    frame: Indices
    """Frame of each piece (P,)."""
    width: Array
    """Width (P,)."""
    top: Array
    """Height of the topmost elements (P,)."""
    spans: tuple[Array, Array]
    """Spans along x, and y: frame, low, high, size (N, 4)."""


def _pieces_of(
    touched: Mask,
    x: Array,
    y: Array,
    thickness: float,
    edge_radius: float = math.inf,
    on_body: Mask | None = None,
) -> _Pieces:
    """Return the pieces of contacts (F, X, Y); further arguments as in `sizes_of`."""
    on_body = np.ones(touched.shape[1:], bool) if on_body is None else on_body
    edges_x, edges_y = pixel_edges(x), pixel_edges(y)
    numbered, count = ndimage.label(touched, structure=BESIDE)
    boxes = ndimage.find_objects(numbered)
    frame = np.array([box[0].start for box in boxes], int)
    width, top = np.empty((2, count))
    spans = [np.empty((0, 4))], [np.empty((0, 4))]
    some = max(1, PIXELS_MOST // touched[0].size)
    for first in range(0, count, some):
        here = slice(first, first + some)
        of_x, of_y = (
            slice(
                max(min(box[axis].start for box in boxes[here]) - ASIDE, 0),
                max(box[axis].stop for box in boxes[here]) + ASIDE,
            )
            for axis in (1, 2)
        )
        number = np.arange(1, count + 1)[here, None, None]
        mask, body = numbered[frame[here], of_x, of_y] == number, on_body[of_x, of_y]
        edges = (edges_x[of_x.start : of_x.stop + 1], edges_y[of_y.start : of_y.stop + 1])
        width[here] = 2 * half_widths(mask, *edges)
        size = np.minimum(width[here] / ACROSS, LAYER_SHARE * thickness)
        edge = np.minimum(size, np.maximum(EDGE_SHARE * edge_radius, EDGE_LEAST * size))
        across = np.maximum(np.abs(_normals(mask)), OBLIQUE)
        properties = np.stack([frame[here], width[here], size, edge])
        spans[0].extend(_runs(mask, body, across[0], edges[0], properties))
        turned = mask.transpose(0, 2, 1), body.T, across[1].transpose(0, 2, 1)
        spans[1].extend(_runs(*turned, edges[1], properties))
        top[here] = np.minimum(OVER_DEPTH * size, edge)
    return _Pieces(frame, width, top, (np.concatenate(spans[0]), np.concatenate(spans[1])))


# Error of the force times the square of the layers of elements, where a wide contact squeezes a
# nearly incompressible skin between two surfaces that hold it; times the second if it slides on one
# of them. With friction and nu 0.49, planes, punches and spheres that touch 3 to 5 thicknesses are
# off by 0.5 to 0.9 (meshes of 3 to 10 layers), with nu 0.45 by 0.3 to 0.5.
SQUEEZE, SQUEEZE_FREE = 1.2, 0.6
# Scale of 1 - 2 nu at which a skin compresses instead of flowing, and the power of the transition.
VOLUME, VOLUME_POWER = 18.0, 1.3
# Contact widths, in thicknesses, at which squeezing of the skin below begins and is complete.
SQUEEZED_FROM, SQUEEZED_ALL = 1.5, 3.5
# Allowed error of this kind at fineness 1.
SQUEEZE_ERROR = 0.016


def squeeze(scene: Scene, width: Array | float) -> Array:
    """Return the force error of contacts of `width` [m], times the layers of elements squared.

    A skin that cannot compress flows outwards, fastest half-way down. Layers of linear elements are
    too stiff for that flow, by 1 / layers^2.
    """
    body = scene.body
    wide = (np.asarray(width) / body.thickness - SQUEEZED_FROM) / (SQUEEZED_ALL - SQUEEZED_FROM)
    held = 1.0 if scene.effects.friction is not None else SQUEEZE_FREE
    gives = 1.0 + (VOLUME * (1.0 - 2.0 * body.poisson)) ** VOLUME_POWER
    return np.asarray(SQUEEZE * held * np.clip(wide, 0.0, 1.0) / gives)


def _normals(mask: Mask) -> Array:
    """Return unit normals of outlines at the pixels of masks (P, X, Y), as (2, P, X, Y).

    They are in pixels, not metres. The ends of the grid count as outline: they are the ends of the
    body, if a contact reaches them.
    """
    if 1 in mask.shape[1:]:
        slope = np.ones((2, *mask.shape))
    else:
        soft = ndimage.gaussian_filter(mask.astype(float), SMOOTH, mode="constant", axes=(1, 2))
        slope = np.stack([_slopes(soft, 1), _slopes(soft, 2)])
    length = np.maximum(np.sqrt(slope[0] ** 2 + slope[1] ** 2), 1e-12)
    return np.asarray(slope / length)


def _slopes(values: Array, axis: int) -> Array:
    """Return differences along an axis, as `np.gradient` does, in a tenth of its time."""
    values = np.moveaxis(values, axis, 0)
    slope = np.empty_like(values)
    slope[1:-1] = (values[2:] - values[:-2]) / 2
    slope[0], slope[-1] = values[1] - values[0], values[-1] - values[-2]
    return np.moveaxis(slope, 0, axis)


def _runs(mask: Mask, on_body: Mask, across: Array, edges: Array, pieces: Array) -> list[Array]:
    """Return spans of the runs of touched pixels along x, and of their end edges.

    Pixels of each piece touch where `mask` (P, X, Y) says so; a contact that ends at the rim of
    those `on_body` (X, Y) has an edge there. `across` is the cosine between x and the outline's
    normal (P, X, Y), `edges` are between pixels (X + 1,). `pieces` (4, P) has the frame of each
    piece, its width, and the sizes across it and at its outline: a run much longer than the piece
    is wide is refined to the latter only at its ends. Tables have frame, low, high, size (N, 4).
    """
    framed = np.zeros((len(mask), mask.shape[1] + 2, mask.shape[2]), np.int8)
    framed[:, 1:-1] = mask
    change = np.diff(framed, axis=1).transpose(0, 2, 1)
    piece, column, first = np.nonzero(change == 1)
    past = np.nonzero(change == -1)[2]
    frame, width, size, edge = pieces[:, piece]
    low, high = edges[first], edges[past]
    begin, end = across[piece, first, column], across[piece, past - 1, column]
    within = size / np.maximum(begin, end)
    long = high - low > LONG * width
    tables = [
        (frame, low, np.where(long, low + width, high), within),
        (frame[long], high[long] - width[long], high[long], within[long]),
    ]
    body = np.zeros((mask.shape[1] + 2, mask.shape[2]), bool)
    body[1:-1] = on_body
    for at, way, on in ((low, begin, body[first, column]), (high, end, body[past + 1, column])):
        here = np.where(on, edge, EDGE_LEAST * size)
        fine = here < size
        tables.append((frame[fine], (at - here)[fine], (at + here)[fine], (here / way)[fine]))
    return [np.stack(each, axis=1) for each in tables]


def _least(spans: Sequence[Span]) -> tuple[Span, ...]:
    """Drop the spans that lie within another one that is as fine."""
    finest: list[Span] = []
    for span in sorted(set(spans), key=lambda one: (one.size, one.low - one.high, one.low)):
        if not any(
            one.size <= 1.05 * span.size and one.low <= span.low and span.high <= one.high
            for one in finest
        ):
            finest.append(span)
    return tuple(finest)


# Node positions along one axis, from the required sizes.


def places_of(
    spans: Sequence[Span],
    low: float,
    high: float,
    *,
    growth: float,
    longest: float,
    fineness: float = 1.0,
) -> tuple[Array, Array]:
    """Return cumulative element counts from `low` (N,), rising from 0, and their positions (N,).

    Element length grows by `growth`, per distance from a span, up to `longest`; `fineness` divides
    every size.
    """
    sites = [np.linspace(low, high, SITES)]
    for span in spans:
        reach = span.high - span.low + 4 * span.size
        sites.append(np.linspace(span.low - reach, span.high + reach, 65))
    position = np.unique(np.clip(np.concatenate(sites), low, high))
    size = np.full(len(position), longest)
    for span in spans:
        inside = (position >= span.low) & (position <= span.high)
        size[inside] = np.minimum(size[inside], span.size)
    forward = np.minimum.accumulate(size - growth * position) + growth * position
    backward = np.minimum.accumulate((size + growth * position)[::-1])[::-1] - growth * position
    density = fineness / np.minimum(forward, backward)
    return np.asarray(cumulative_trapezoid(density, position, initial=0.0)), position


def resolved(touched: Mask, x: Array, y: Array, *, body: Body, top: float) -> Array:
    """Return how finely a mesh resolves contacts solved on it (F,); inf if nothing touches.

    1 corresponds to 12 elements from one side of the contact to the other. `touched` are nodes of
    the top at x (X,) and y (Y,) [m] in each frame (F, X, Y); `top` is the height of the topmost
    elements [m].
    """
    pieces = _pieces_of(touched, x, y, body.thickness)
    coarser = np.where(touched.any(axis=(1, 2)), 1e-6, 0.0)
    np.maximum.at(coarser, pieces.frame, top / (FLATTER * pieces.top))
    for spans, nodes in zip(pieces.spans, (x, y), strict=True):
        length, (frame, low, high, size) = np.diff(nodes), spans.T
        here = (nodes[1:] > low[:, None]) & (nodes[:-1] < high[:, None])
        ratio = np.where(here, length, 0.0).max(axis=1) / size
        np.maximum.at(coarser, frame.astype(int), ratio)
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / coarser)


# Height of the topmost elements, over that of a mesh that follows the contact, at which it limits
# the resolution as much as their sides do: forces depend on it much less.
FLATTER = 2.5


def coarser_than_required(sizes: Sizes, x: Array, y: Array, fineness: float = 1.0) -> float:
    """Return the largest ratio of element length to required size; 1 or less is fine enough.

    Nodes are at x (X,) and y (Y,); `fineness` is as in `places_of`.
    """
    worst = 0.0
    for spans, nodes in ((sizes.x, x), (sizes.y, y)):
        length = np.diff(nodes)
        for span in spans:
            here = (nodes[1:] > span.low) & (nodes[:-1] < span.high)
            if here.any():
                worst = max(worst, float(length[here].max()) * fineness / span.size)
    return worst


def finer_at(place: Sequence[float], x: Array, y: Array, fineness: float) -> Sizes:
    """Return sizes that halve elements around a point (x, y, ...) [m], nodes at x and y."""
    spans = []
    for nodes, middle in ((x, place[0]), (y, place[1])):
        cell = int(np.clip(np.searchsorted(nodes, middle) - 1, 0, len(nodes) - 2))
        length = float(nodes[cell + 1] - nodes[cell])
        spans.append(Span(middle - 1.5 * length, middle + 1.5 * length, length * fineness / 2))
    return Sizes((spans[0],), (spans[1],), OVER_DEPTH * min(spans[0].size, spans[1].size))


# Estimate of the contact before the solve.

# Pixels along the longer side of a window on a contact.
WINDOW = 64
# Sides of a window that differ more than this have twice as many pixels.
NARROW = 4
# Least pixels along the shorter side, and most along the longer one: a needle's contact may be
# hundreds of times as long as it is wide.
NARROW_PIXELS, WINDOW_MOST = 4, 512
# Rim around the area of the undeformed top that the indenter covers, over its width.
WIDER = 0.15
# Largest thickness of the linear layer, in narrower sides of the window: a thicker one responds to
# a contact of that size the same within a few per cent.
LAYERS = 2.0
# Natural residual to which the layer's contact is solved: only the width is needed.
RESIDUAL = 0.02
# Most contacts of a motion that are estimated.
LOOKS = 24
# Largest contact over the smallest that one mesh resolves. A wider range of element sizes makes the
# equations so hard to solve that it is cheaper to solve a beginning separately.
MANY_SIZES = 4.0
# Depths within this factor of each other have similar contacts.
ALIKE = 1.25
# Points along x and y, and heights, at which an indenter is sampled; the second pass samples only
# the box that the first has found.
SAMPLES, LEVELS, PASSES = 61, 6, 2
# Most passes that look for a shape between the points, around the closest one.
CLOSER = 4


@dataclass(frozen=True, slots=True)
class MotionStage:
    """Waypoints from the beginning of a motion that one mesh resolves."""

    waypoints: int
    """Number of waypoints; the first stage has all, and later stages replace its beginning."""
    sizes: Sizes


def stages_of(scene: Scene) -> list[MotionStage]:
    """Return the stages and mesh sizes that a scene needs; the first is for all waypoints.

    A motion that begins with contacts much smaller than the later ones gets a separate mesh for its
    beginning: with one mesh for all, the range of element sizes would make the equations hard to
    solve. Up to there nothing is different, so a beginning may be solved alone with any effects.
    """
    looks = _looks(scene)
    count = len(scene.motion)
    if all(look.top == math.inf for look in looks):
        return [MotionStage(count, NOTHING)]
    stages: list[MotionStage] = []
    while True:
        tops = {i: look.top for i, look in enumerate(looks[:count]) if look.top < math.inf}
        if not tops and stages:
            return stages
        if not tops:  # only the ways between waypoints press
            tops = {0: max(look.top for look in looks if look.top < math.inf)}
        least_size = max(tops.values()) / MANY_SIZES
        joined = NOTHING
        for look in looks[:count] if stages else looks:
            joined = joined.joined(_no_finer(look, least_size))
        stages.append(MotionStage(count, replace(joined, x=_least(joined.x), y=_least(joined.y))))
        first = next(i for i, top in tops.items() if top >= least_size)
        smaller = [i for i in tops if i < first]
        if not smaller:
            return stages
        count = smaller[-1] + 1


def _no_finer(sizes: Sizes, least_size: float) -> Sizes:
    """Return sizes with topmost elements at least `least_size` high, and those in plan to match."""
    if sizes.top >= least_size:
        return sizes
    least = least_size / OVER_DEPTH
    x, y = (
        tuple(Span(one.low, one.high, max(one.size, least)) for one in spans)
        for spans in (sizes.x, sizes.y)
    )
    return replace(sizes, x=x, y=y, top=least_size)


def _looks(scene: Scene) -> list[Sizes]:
    """Return the sizes for the contact at each waypoint, then for points along long slides.

    Similar contacts are estimated once. `NOTHING` also stands for those beyond the limit of
    estimates per motion.
    """
    waypoints = np.asarray(scene.motion.tip)
    depth = scene.motion.depth_max
    if depth <= 0:
        waypoints = waypoints - [0.0, 0.0, 1e-3 * scene.body.thickness + waypoints[:, 2].min()]
    ways: list[Array] = []
    for start, end in pairwise(waypoints):
        parts = 1 + min(4, int(np.linalg.norm((end - start)[:2]) / max(depth, 1e-9)))
        ways += [start + (end - start) * part / parts for part in range(1, parts)]
    tips = np.array([*waypoints, *ways])
    sizes_at = [NOTHING] * len(tips)
    estimated: list[tuple[Array, float, Sizes]] = []
    for index in np.argsort(tips[:, 2], kind="stable").tolist():
        tip = tips[index]
        down = _height_below(scene.body, tip) - float(tip[2])
        if down <= 0:
            continue
        for other, deep, sizes in estimated:
            near = float(np.linalg.norm((tip - other)[:2])) <= down / 4
            if near and deep / ALIKE < down < deep * ALIKE:
                sizes_at[index] = sizes
                break
        else:
            if len(estimated) < LOOKS:
                sizes_at[index] = _look(scene.indenter, scene.body, tuple(tip.tolist()))
                estimated.append((tip, down, sizes_at[index]))
    return sizes_at


def _height_below(body: Body, tip: Array) -> float:
    return float(_heights(body, tip[:1], tip[1:2])[0, 0])


@lru_cache(maxsize=4096)
def _look(indenter: Indenter, body: Body, at: tuple[float, ...]) -> Sizes:
    """Return the sizes for the contact with the tip at three coordinates; cached."""
    from sim.layer.contact import THIN as THIN_LAYER
    from sim.layer.contact import solve_frictionless
    from sim.layer.spectral import Convolutions, PixelGrid

    tip = np.array(at)
    box = covered(indenter, body, tip)
    if box is None:
        return NOTHING
    low, high = box
    width = np.maximum(high - low, 1e-4)
    middle, width = (low + high) / 2, width * (1 + 2 * WIDER)
    longest = float(width.max())
    width = np.maximum(width, longest * NARROW_PIXELS / WINDOW_MOST)
    count = WINDOW * (2 if longest > NARROW * width.min() else 1)
    count = max(count, min(math.ceil(NARROW_PIXELS * longest / width.min()), WINDOW_MOST))
    here = body.thickness + _height_below(body, tip)
    here = here if here < THIN * body.thickness else body.thickness
    thickness = float(np.clip(here, 1e-4, LAYERS * width.min()))
    side_x, side_y = width.tolist()
    grid = PixelGrid(Body(side_x, side_y, thickness, body.modulus, body.poisson), count)
    x, y = grid.x + middle[0], grid.y + middle[1]
    reach = max(body.thickness, 2 * abs(float(tip[2])))
    height = indenter.heights(x[:, None] - tip[0], y - tip[1], reach=reach, thinnest=THIN_LAYER)
    on_body = body.covers(x[:, None], y)
    gap = np.minimum(height, reach) + tip[2] - _heights(body, x, y)
    gap = np.where(on_body, gap, reach)
    layer = Convolutions(grid, np.float32).within(grid.shape)
    start = np.zeros((3, *grid.shape), np.float32)
    contact = solve_frictionless(layer, gap.astype(np.float32), start, tolerance=RESIDUAL)
    return sizes_of(contact.traction[2] < 0, x, y, here, indenter.sharpest, on_body)


# Height of a dome over the thickness below which a contact there counts as on a thinner layer.
THIN = 0.5


def _heights(body: Body, x: Array, y: Array) -> Array:
    """Return heights of the undeformed top; beyond its sides, those at the sides."""
    half_x, half_y = body.size_x / 2, body.size_y / 2
    return body.heights(np.clip(x, -half_x, half_x), np.clip(y, -half_y, half_y))


def covered(indenter: Indenter, body: Body, tip: Array) -> tuple[Any, Any] | None:
    """Return least and greatest (x, y) of the undeformed top that an indenter at `tip` overlaps."""
    half = np.array([body.size_x, body.size_y]) / 2
    deep = max(0.0, max(_height_below(body, tip), 0.0) - float(tip[2]))
    bounds = np.array(indenter.bounds_below(deep)[:2])
    low = np.maximum(bounds[:, 0] + tip[:2], -half)
    high = np.minimum(bounds[:, 1] + tip[:2], half)
    if (low >= high).any():
        return None

    def outside(x: Array, y: Array, level: float, columns: Mask) -> Array:
        top = _heights(body, x, y)
        there = ((top >= tip[2]) & body.covers(x[:, None], y))[columns]
        points = np.empty((len(there), 3))
        for axis, at in enumerate(np.broadcast_arrays(x[:, None] - tip[0], y - tip[1])):
            points[:, axis] = at[columns]
        points[:, 2] = level * np.maximum(top - tip[2], 0.0)[columns]
        return np.where(there, indenter.distance(points)[0], np.inf)

    return extent_of(outside, low, high)


def extent_of(
    outside: Callable[[Array, Array, float, Mask], Array], low: Array, high: Array
) -> tuple[Array, Array] | None:
    """Return least and greatest (x, y) inside a shape within a box; None if nowhere.

    The extent is found on a grid of points and widened by the grid spacing. A shape between the
    points, such as a corner that has just touched, is looked for where they are closest to it.
    `outside` maps x (X,), y (Y,), a level, 0 (lowest) to 1, and columns (X, Y) to the columns'
    signed distances from the shape at the level (N,), inf where there is no point.
    """
    closer, passes = CLOSER, PASSES
    while True:
        x, y = (np.linspace(low[axis], high[axis], SAMPLES) for axis in (0, 1))
        distance, spacing = np.full((SAMPLES, SAMPLES), np.inf), (high - low) / (SAMPLES - 1)
        columns = np.ones_like(distance, bool)
        for level in np.linspace(0.0, 1.0, LEVELS)[::-1].tolist():
            if columns.any():
                distance[columns] = np.minimum(distance[columns], outside(x, y, level, columns))
            inside = distance <= 0
            if inside.any():  # columns within the extent so far add nothing to it
                in_x, in_y = (np.flatnonzero(inside.any(axis=axis)) for axis in (1, 0))
                columns[in_x[0] : in_x[-1] + 1, in_y[0] : in_y[-1] + 1] = False
        if inside.any():
            passes -= 1
        elif closer and distance.min() <= np.linalg.norm(spacing):
            in_x, in_y = (
                np.array([at]) for at in np.unravel_index(distance.argmin(), inside.shape)
            )
            closer -= 1
        else:
            return None
        least = np.array([x[in_x[0]], y[in_y[0]]]) - spacing
        most = np.array([x[in_x[-1]], y[in_y[-1]]]) + spacing
        low, high = np.maximum(least, low), np.minimum(most, high)
        if not passes:
            return low, high
