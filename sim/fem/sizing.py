"""How small elements must be: as small as what touches, where it touches.

A contact is looked at before anything is solved, by a linear layer on a window of its own size
(milliseconds), and again on the solution. What touches is a set of pixels; its connected pieces
have a width each, and elements are a share of that width from one side of a piece to the other.
From there they grow outwards and downwards. So neither the body's size nor its thickness decides
how finely a contact is resolved.

Lengths in metres, in the contact frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from sim.contact_size import half_width, pixel_edges, touched_by
from sim.indenters import Indenter
from sim.scene import Body, Scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Elements from one side of a contact to the other, with a fineness of 1.
ACROSS = 12
# Height of the topmost elements over the least side of those in contact.
OVER_DEPTH = 0.6
# How much longer an element is than the fine ones, per distance from them: in plan, in depth.
GROWTH, GROWTH_DOWN = 0.3, 0.18
# Longest element under a contact, in thicknesses: a wide contact on a thin layer is resolved as the
# layer's own edge, which is about as wide as the layer is thick.
LAYER_SHARE = 0.25
# Tallest element, in thicknesses.
DEEPEST = 1 / 3
# Least cosine between an axis and the outline's normal that counts: an outline along an axis asks
# for nothing along it.
OBLIQUE = 0.2
# Size at the outline of a contact over the smallest radius of the indenter's surface, which may
# bound it; its least over the size within: the force of a punch is 4 % too large where elements are
# as long as the radius of its edge.
EDGE_SHARE, EDGE_LEAST = 0.35, 0.25
# Length of a run of touched pixels, in widths of its piece, from which its middle is coarser.
LONG = 3.0
# Places along an axis at which sizes are told, and about as many more in the contacts.
SITES = 2001


@dataclass(frozen=True, slots=True)
class Span:
    """Elements no longer than `size` from `low` to `high` along one axis."""

    low: float
    high: float
    size: float


@dataclass(frozen=True, slots=True)
class Sizes:
    """What the contacts of a motion ask of a mesh."""

    x: tuple[Span, ...]
    y: tuple[Span, ...]
    top: float
    """Height of the topmost elements; inf where nothing touches."""
    width: float = 0.0
    """Of the widest piece of a contact, 0 where nothing touches."""

    def joined(self, other: Sizes) -> Sizes:
        """What both ask for."""
        return Sizes(
            self.x + other.x,
            self.y + other.y,
            min(self.top, other.top),
            max(self.width, other.width),
        )


NOTHING = Sizes((), (), math.inf)


def sizes_of(
    touched: Mask,
    x: Array,
    y: Array,
    thickness: float,
    edge_radius: float = math.inf,
    on_body: Mask | None = None,
) -> Sizes:
    """What one contact asks for.

    Args:
        touched: Which pixels or nodes touch (X, Y).
        x: Where they stand (X,), rising, evenly or not.
        y: The same along y (Y,).
        thickness: Of the body.
        edge_radius: Smallest radius of the indenter's surface, which may bound what touches.
        on_body: Which pixels are the body's (X, Y); None: all of them.
    """
    if not touched.any():
        return NOTHING
    on_body = np.ones_like(touched) if on_body is None else on_body
    edges_x, edges_y = pixel_edges(x), pixel_edges(y)
    pieces, count = ndimage.label(touched, structure=np.ones((3, 3)))
    spans: tuple[list[Span], list[Span]] = ([], [])
    top, widest = math.inf, 0.0
    for piece in range(1, count + 1):
        mask = pieces == piece
        width = 2 * half_width(mask, edges_x, edges_y)
        widest = max(widest, width)
        size = min(width / ACROSS, LAYER_SHARE * thickness)
        normal = _normals(mask)
        edge = min(size, max(EDGE_SHARE * edge_radius, EDGE_LEAST * size))
        for axis, edges in enumerate((edges_x, edges_y)):
            across, asked = np.maximum(np.abs(normal[axis]), OBLIQUE), (width, size, edge)
            if axis:
                found = _runs(mask.T, on_body.T, across.T, edges, asked)
            else:
                found = _runs(mask, on_body, across, edges, asked)
            spans[axis].extend(found)
        top = min(top, OVER_DEPTH * size, edge)
    return Sizes(_least(spans[0]), _least(spans[1]), top, widest)


# Error of the force times the square of the layers of elements, where a wide contact squeezes a
# skin that keeps its volume between two surfaces that hold it; times the second where it slides on
# one of them. With friction and nu 0.49 planes, punches and spheres that touch 3 to 5 thicknesses
# are off by 0.5 to 0.9 (meshes of 3 to 10 layers), with nu 0.45 by 0.3 to 0.5.
SQUEEZE, SQUEEZE_FREE = 1.2, 0.6
# 1 - 2 nu at which a skin gives way instead of flowing, and how that sets in.
VOLUME, VOLUME_POWER = 18.0, 1.3
# Width of a contact, in thicknesses, from which the skin below is squeezed, and all of it is.
SQUEEZED_FROM, SQUEEZED_ALL = 1.5, 3.5
# What such an error may be with a fineness of 1.
SQUEEZE_ERROR = 0.016


def squeeze(scene: Scene, width: Array | float) -> Array:
    """Error of the force of contacts of a width [m] times the square of the layers of elements.

    A skin that cannot give way flows outwards, fastest half-way down: a flow that layers of linear
    elements across it are too stiff for, by 1 / layers^2.
    """
    body = scene.body
    wide = (np.asarray(width) / body.thickness - SQUEEZED_FROM) / (SQUEEZED_ALL - SQUEEZED_FROM)
    held = 1.0 if scene.effects.friction is not None else SQUEEZE_FREE
    gives = 1.0 + (VOLUME * (1.0 - 2.0 * body.poisson)) ** VOLUME_POWER
    return np.asarray(SQUEEZE * held * np.clip(wide, 0.0, 1.0) / gives)


def _normals(mask: Mask) -> Array:
    """Unit normals of a piece's outline, at its pixels (2, X, Y); by pixels, not by metres.

    The ends of the grid are an outline too: those of the body, where a contact goes so far.
    """
    soft = ndimage.gaussian_filter(mask.astype(float), 1.5, mode="constant")
    slope = np.stack(np.gradient(soft)) if min(mask.shape) > 1 else np.ones((2, *mask.shape))
    length = np.maximum(np.linalg.norm(slope, axis=0), 1e-12)
    return np.asarray(slope / length)


def _runs(
    mask: Mask,
    on_body: Mask,
    across: Array,
    edges: Array,
    asked: tuple[float, float, float],
) -> Iterable[Span]:
    """Spans of the runs of touched pixels along the first axis, and of the edges they end at.

    Args:
        mask: What touches (X, Y).
        on_body: What is the body's (X, Y): a contact that ends at the body's rim has an edge there.
        across: Cosine between the first axis and the outline's normal (X, Y).
        edges: Between the pixels (X + 1,).
        asked: Width of the piece, size from one side of it to the other, and at its outline. A run
            much longer than the piece is wide is as fine as that at its ends alone.
    """
    width, size, edge = asked
    framed = np.zeros((2, len(mask) + 2, mask.shape[1]), np.int8)
    framed[:, 1:-1] = mask, on_body
    change = np.diff(framed[0], axis=0).T
    column, first = np.nonzero(change == 1)
    past = np.nonzero(change == -1)[1]
    low, high = edges[first], edges[past]
    begin, end = across[first, column], across[past - 1, column]
    within = size / np.maximum(begin, end)
    long = high - low > LONG * width
    spans = [
        (low[~long], high[~long], within[~long]),
        (low[long], low[long] + width, within[long]),
        (high[long] - width, high[long], within[long]),
    ]
    beside = framed[1] == 0
    for at, way, rim in (
        (low, begin, beside[first, column]),
        (high, end, beside[past + 1, column]),
    ):
        here = np.where(rim, EDGE_LEAST * size, edge)
        fine = here < size
        spans.append(((at - here)[fine], (at + here)[fine], (here / way)[fine]))
    table = np.concatenate([np.stack(span, axis=1) for span in spans])
    return (Span(*row) for row in set(map(tuple, table.tolist())))


def _least(spans: Sequence[Span]) -> tuple[Span, ...]:
    """The same demand by fewer spans: those that no other one holds and is as fine as."""
    kept: list[Span] = []
    for span in sorted(set(spans), key=lambda one: (one.size, one.low - one.high, one.low)):
        if not any(
            one.size <= 1.05 * span.size and one.low <= span.low and span.high <= one.high
            for one in kept
        ):
            kept.append(span)
    return tuple(kept)


# Where the nodes of one axis stand, for what is asked of it.


def places_of(
    spans: Sequence[Span],
    low: float,
    high: float,
    *,
    growth: float,
    longest: float,
    fineness: float = 1.0,
) -> tuple[Array, Array]:
    """Elements counted from `low` (N,), rising from 0, at places (N,) between `low` and `high`.

    Args:
        spans: What is asked for.
        low: Where the axis begins.
        high: Where it ends.
        growth: How much longer an element is, per distance from a span.
        longest: Longest element.
        fineness: Divides every size.
    """
    sites = [np.linspace(low, high, SITES)]
    for span in spans:
        reach = span.high - span.low + 4 * span.size
        sites.append(np.linspace(span.low - reach, span.high + reach, 65))
    place = np.unique(np.clip(np.concatenate(sites), low, high))
    size = np.full(len(place), longest)
    for span in spans:
        inside = (place >= span.low) & (place <= span.high)
        size[inside] = np.minimum(size[inside], span.size)
    forward = np.minimum.accumulate(size - growth * place) + growth * place
    backward = np.minimum.accumulate((size + growth * place)[::-1])[::-1] - growth * place
    density = fineness / np.minimum(forward, backward)
    counted = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(place))])
    return counted, place


def resolved(
    traction: NDArray[np.floating[Any]], x: Array, y: Array, *, body: Body, top: float
) -> float:
    """How finely a mesh resolves a contact that was solved on it; inf where nothing touches.

    1 are 12 elements from one side of the contact to the other.

    Args:
        traction: At the nodes of the top (X, Y, 3).
        x: Where they stand (X,) [m].
        y: The same along y (Y,) [m].
        body: Which was meshed.
        top: Height of the topmost elements [m].
    """
    touched = touched_by(traction)
    if not touched.any():
        return math.inf
    asked = sizes_of(touched, x, y, body.thickness)
    return 1.0 / max(coarser_than_asked(asked, x, y), top / (FLATTER * asked.top), 1e-6)


# Height of the topmost elements over that of a mesh that follows the contact, at which it costs as
# much as their sides: forces hang on it much less.
FLATTER = 2.5


def coarser_than_asked(sizes: Sizes, x: Array, y: Array, fineness: float = 1.0) -> float:
    """Largest element over what is asked for where it stands; 1 or less is as fine as asked.

    Args:
        sizes: What is asked for.
        x: Where the nodes stand (X,).
        y: The same along y (Y,).
        fineness: As of `places_of`.
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
    """What makes the elements around a point (x, y, ...) [m] half as long.

    Args:
        place: The point.
        x: Where the nodes stand (X,).
        y: The same along y (Y,).
        fineness: As of `places_of`.
    """
    spans = []
    for nodes, middle in ((x, place[0]), (y, place[1])):
        cell = int(np.clip(np.searchsorted(nodes, middle) - 1, 0, len(nodes) - 2))
        length = float(nodes[cell + 1] - nodes[cell])
        spans.append(Span(middle - 1.5 * length, middle + 1.5 * length, length * fineness / 2))
    return Sizes((spans[0],), (spans[1],), OVER_DEPTH * min(spans[0].size, spans[1].size))


# What touches, before anything is solved.

# Pixels along the longer side of a window on a contact.
WINDOW = 64
# Sides of a window that differ more than this have twice as many pixels.
NARROW = 4
# Rim around what the indenter covers of the untouched top, over its width.
WIDER = 0.15
# Thickness of the linear layer at most, in narrower sides of the window: a thicker one answers a
# contact of that size alike within a few per cent.
LAYERS = 2.0
# Natural residual to which the layer's contact is solved: its width is what counts.
RESIDUAL = 0.02
# Contacts of a motion that are looked at, at most.
LOOKS = 24
# Largest contact over the smallest that one mesh resolves; sizes of elements that differ more make
# the equations so hard that a beginning is better solved alone.
MANY_SIZES = 4.0
# Depths less than this apart have alike contacts.
ALIKE = 1.25
# Points along x and y, and heights, at which an indenter is looked at; the second pass looks only
# where the first has found it.
SAMPLES, LEVELS, PASSES = 61, 6, 2


@dataclass(frozen=True, slots=True)
class Stage:
    """Waypoints of a motion, from its beginning, that one mesh resolves."""

    waypoints: int
    """How many; the first stage has all of them, and those of later stages take their place."""
    sizes: Sizes


def stages_of(scene: Scene) -> list[Stage]:
    """The meshes that a scene takes, by a look at its contacts; the first is for all waypoints.

    A motion that begins with contacts much smaller than those to come has a mesh for its beginning:
    one mesh for all would have elements of so many sizes that its equations are hard to solve. Up
    to there nothing is different, so a beginning may be solved alone, whatever the effects.
    """
    looks = _looks(scene)
    found = [look for look in looks if look is not None and look.top < math.inf]
    count = len(scene.motion)
    if not found:
        return [Stage(count, NOTHING)]
    stages: list[Stage] = []
    while True:
        seen = [look for look in looks[:count] if look is not None and look.top < math.inf]
        if not seen:
            return stages
        floor = max(look.top for look in seen) / MANY_SIZES
        joined = NOTHING
        for look in [*seen, *(looks[len(scene.motion) :] if not stages else [])]:
            if look is not None:
                joined = joined.joined(_no_finer(look, floor))
        stages.append(Stage(count, replace(joined, x=_least(joined.x), y=_least(joined.y))))
        before = 0
        for index, look in enumerate(looks[:count]):
            if look is None or look.top >= math.inf:
                continue
            if look.top >= floor:
                break
            before = index + 1
        if before == 0:
            return stages
        count = before


def _no_finer(sizes: Sizes, floor: float) -> Sizes:
    """The same with no topmost element less than `floor` high, and those in plan to match."""
    if sizes.top >= floor:
        return sizes
    least = floor / OVER_DEPTH
    x, y = (
        tuple(Span(one.low, one.high, max(one.size, least)) for one in spans)
        for spans in (sizes.x, sizes.y)
    )
    return replace(sizes, x=x, y=y, top=floor)


def _looks(scene: Scene) -> list[Sizes | None]:
    """What the contact at each waypoint asks for, then that at places on long slides.

    Of contacts that are alike one is looked at; None stands for a tip above the body, or past the
    number of looks that a motion is worth.
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
    found: list[Sizes | None] = [None] * len(tips)
    known: list[tuple[Array, float, Sizes]] = []
    for index in np.argsort(tips[:, 2], kind="stable").tolist():
        tip = tips[index]
        down = scene.body.height(*_onto(scene.body, tip)) - float(tip[2])
        if down <= 0:
            continue
        for other, deep, sizes in known:
            near = float(np.linalg.norm((tip - other)[:2])) <= down / 4
            if near and deep / ALIKE < down < deep * ALIKE:
                found[index] = sizes
                break
        else:
            if len(known) < LOOKS:
                found[index] = _look(scene.indenter, scene.body, tip)
                known.append((tip, down, found[index]))
    return found


def _onto(body: Body, tip: Array) -> tuple[float, float]:
    return (
        float(np.clip(tip[0], -body.size_x / 2, body.size_x / 2)),
        float(np.clip(tip[1], -body.size_y / 2, body.size_y / 2)),
    )


def _look(indenter: Indenter, body: Body, tip: Array) -> Sizes:
    """What the contact with the tip at (3,) asks for."""
    from sim.layer.contact import solve_frictionless
    from sim.layer.spectral import Convolutions, Grid

    box = covered(indenter, body, tip)
    if box is None:
        return NOTHING
    low, high = box
    width = np.maximum(high - low, 1e-4)
    middle, width = (low + high) / 2, width * (1 + 2 * WIDER)
    count = WINDOW * (2 if width.max() > NARROW * width.min() else 1)
    here = _thickness_under(body, tip)
    thickness = float(np.clip(here, 1e-4, LAYERS * width.min()))
    window = Body(
        size_x=float(width[0]),
        size_y=float(width[1]),
        thickness=thickness,
        modulus=body.modulus,
        poisson=body.poisson,
    )
    grid = Grid(window, count)
    x, y = grid.x + middle[0], grid.y + middle[1]
    reach = max(body.thickness, 2 * abs(float(tip[2])))
    height = indenter.heights(x[:, None] - tip[0], y[None, :] - tip[1], reach=reach)
    on_body = body.covers(x[:, None], y)
    gap = np.minimum(height, reach) + tip[2] - _heights(body, x, y)
    gap = np.where(on_body, gap, reach)
    layer = Convolutions(grid, np.float32).within(grid.shape)
    start = np.zeros((3, *grid.shape), np.float32)
    contact = solve_frictionless(layer, gap.astype(np.float32), start, tolerance=RESIDUAL)
    return sizes_of(contact.traction[2] < 0, x, y, here, indenter.sharpest, on_body)


# Height of a dome over the thickness below which a contact there is one on a thinner layer.
THIN = 0.5


def _thickness_under(body: Body, tip: Array) -> float:
    """Height of the body under a tip (3,), where it is much less than the thickness; else that."""
    here = body.thickness + body.height(*_onto(body, tip))
    return here if here < THIN * body.thickness else body.thickness


def _heights(body: Body, x: Array, y: Array) -> Array:
    """Heights of the untouched top; beyond its sides those at the sides."""
    half_x, half_y = body.size_x / 2, body.size_y / 2
    return body.heights(np.clip(x, -half_x, half_x), np.clip(y, -half_y, half_y))


def covered(indenter: Indenter, body: Body, tip: Array) -> tuple[Any, Any] | None:
    """Least and greatest (x, y) of the untouched top that an indenter at `tip` overlaps, if any."""
    half = np.array([body.size_x, body.size_y]) / 2
    highest = float(_heights(body, np.array([tip[0]]), np.array([tip[1]]))[0, 0])
    deep = max(0.0, max(highest, 0.0) - float(tip[2]))
    bounds = np.array(indenter.bounds_below(deep)[:2])
    low = np.maximum(bounds[:, 0] + tip[:2], -half)
    high = np.minimum(bounds[:, 1] + tip[:2], half)
    if (low >= high).any():
        return None

    def overlaps(x: Array, y: Array) -> Mask:
        top = _heights(body, x, y)
        under = np.linspace(0.0, 1.0, LEVELS) * np.maximum(top - tip[2], 0.0)[..., None]
        places = np.empty((SAMPLES, SAMPLES, LEVELS, 3))
        places[..., 0] = x[:, None, None] - tip[0]
        places[..., 1] = y[None, :, None] - tip[1]
        places[..., 2] = under
        inside = (indenter.distance(places)[0].min(axis=2) <= 0) & (top >= tip[2])
        return np.asarray(inside & body.covers(x[:, None], y))

    return extent_of(overlaps, low, high)


def extent_of(
    holds: Callable[[Array, Array], Mask], low: Array, high: Array
) -> tuple[Array, Array] | None:
    """Least and greatest (x, y) at which something holds, within a box; None where it never does.

    Found on a grid of points, and widened by what may lie between them.

    Args:
        holds: From x (X,) and y (Y,) to whether it does (X, Y).
        low: Least x and y of the box (2,).
        high: Greatest (2,).
    """
    for _pass in range(PASSES):
        x, y = (np.linspace(low[axis], high[axis], SAMPLES) for axis in (0, 1))
        found = holds(x, y)
        if not found.any():
            return None
        between = (high - low) / (SAMPLES - 1)
        in_x, in_y = (np.unique(place) for place in np.nonzero(found))
        least = np.array([x[in_x[0]], y[in_y[0]]]) - between
        most = np.array([x[in_x[-1]], y[in_y[-1]]]) + between
        low, high = np.maximum(least, low), np.minimum(most, high)
    return low, high
