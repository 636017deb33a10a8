# mypy: ignore-errors
# (Warp reads the annotations of its functions as values, which no type checker follows.)
"""Signed distance on the device: one table of numbers, any indenter in any environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from sim.indenters.indenter import STEEPNESS_MIN, Indenter
from sim.indenters.outline import ARC, FIGURES, JOINS, LINE, POINT, ROW, VIEWS, rows
from sim.indenters.solid import FLAT

# Signed distance to a body from a file on the device, the same as `Field.distance`.

# Nodes along each axis that a cubic spline depends on at a place.
TAPS = 4


def field_function(real: type, table_type: Any) -> Any:
    """Return the Warp function (table, indenter, point) -> (normal, gap) of a tricubic spline."""
    triple = wp.types.vector(3, real)
    quad = wp.types.vector(4, real)
    zero, one, two, three, six = (real(value) for value in (0.0, 1.0, 2.0, 3.0, 6.0))
    four, flat = real(4.0), real(FLAT)

    @wp.func
    def weights(fraction: real):
        left = one - fraction
        return quad(
            left * left * left / six,
            (four + fraction * fraction * (three * fraction - six)) / six,
            (four + left * left * (three * left - six)) / six,
            fraction * fraction * fraction / six,
        )

    @wp.func
    def slopes(fraction: real):
        left = one - fraction
        return quad(
            -left * left / two,
            fraction * (three * fraction - four) / two,
            -left * (three * left - four) / two,
            fraction * fraction / two,
        )

    @wp.func
    def field_distance(table: table_type, indenter: int, x: triple):
        spacing = table.field_place[indenter, 3]
        ny, nz = table.field_size[indenter, 1], table.field_size[indenter, 2]
        node = wp.vec3i()
        fraction = triple()
        beyond = triple()
        for axis in range(3):
            place = (x[axis] - table.field_place[indenter, axis]) / spacing
            held = wp.clamp(place, one, real(table.field_size[indenter, axis] - 3))
            node[axis] = int(held)
            fraction[axis] = held - real(node[axis])
            beyond[axis] = (place - held) * spacing
        corner = ((node[0] - 1) * ny + node[1] - 1) * nz + node[2] - 1
        start = table.field_first[indenter] + corner
        beyond[2] = wp.min(beyond[2], zero)
        along_x, along_y, along_z = weights(fraction[0]), weights(fraction[1]), weights(fraction[2])
        slope_x, slope_y, slope_z = slopes(fraction[0]), slopes(fraction[1]), slopes(fraction[2])
        gap = zero
        gradient = triple()
        # A dynamic bound prevents unrolling, which would give 64 bodies at every call.
        taps = int(TAPS)
        for i in range(taps):
            for j in range(taps):
                row = start + (i * ny + j) * nz
                value = zero
                upward = zero
                for k in range(TAPS):
                    coefficient = table.field[row + k]
                    value += along_z[k] * coefficient
                    upward += slope_z[k] * coefficient
                gap += along_x[i] * along_y[j] * value
                gradient[0] += slope_x[i] * along_y[j] * value
                gradient[1] += along_x[i] * slope_y[j] * value
                gradient[2] += along_x[i] * along_y[j] * upward
        steepness = wp.length(gradient)
        normal = triple(zero, zero, -one)
        if steepness > flat * spacing:
            normal = gradient / steepness
        gap += wp.dot(normal, beyond)
        return quad(normal[0], normal[1], normal[2], gap)

    return field_distance


# Signed distance to joined parts on the device, the same as `Indenter.distance`.

PLAN, TURNED = VIEWS.index("plan"), VIEWS.index("turned")
BAND, CIRCLE, PATH = (FIGURES.index(name) for name in ("band", "circle", "path"))
UNION, SUBTRACT = JOINS.index("union"), JOINS.index("subtract")


def parts_function(real: type, table_type: Any) -> Any:
    """Return the Warp function (table, indenter, point) -> (normal, gap) of joined parts."""
    pair = wp.types.vector(2, real)
    triple = wp.types.vector(3, real)
    quad = wp.types.vector(4, real)
    zero, one = real(0.0), real(1.0)

    @wp.func
    def path_distance(table: table_type, row: int, end: int, p: pair):
        # The nearest piece wins; corners come last and count only if nearer than all pieces.
        nearest = triple(one, zero, real(wp.inf))
        for k in range(row, end):
            kind = int(table.path[k, 0])
            along = pair(table.path[k, 3], table.path[k, 4])
            size = table.path[k, 5]
            offset = p - pair(table.path[k, 1], table.path[k, 2])
            facing = wp.dot(along, offset)
            normal = pair(along[1], -along[0])
            gap = wp.dot(normal, offset)
            nearer = facing >= zero and facing <= size and wp.abs(gap) < wp.abs(nearest[2])
            if kind != LINE:
                length = wp.length(offset)
                side = wp.where(facing < zero, -one, one)
                gap = side * length
                nearer = length < wp.abs(nearest[2]) - table.point
                if kind == ARC:
                    side = wp.where(size < zero, -one, one)
                    gap = side * length - size
                    nearer = facing >= table.path[k, 6] * length and wp.abs(gap) < wp.abs(
                        nearest[2]
                    )
                normal = along
                if length > table.point:
                    normal = offset * (side / length)
            if nearer:
                nearest = triple(normal[0], normal[1], gap)
        return nearest

    @wp.func
    def part_distance(table: table_type, part: int, x: triple):
        view, figure = table.codes[part, 0], table.codes[part, 1]
        p = pair(x[0], x[2])
        if view == PLAN:
            p = pair(x[0], x[1])
        spoke = pair(one, zero)
        if view == TURNED:
            arm = pair(x[0] - table.numbers[part, 4], x[1] - table.numbers[part, 5])
            p = pair(wp.length(arm), x[2])
            if p[0] > zero:
                spoke = arm / p[0]
        first = pair(table.numbers[part, 0], table.numbers[part, 1])
        third, fourth = table.numbers[part, 2], table.numbers[part, 3]
        answer = triple(one, zero, zero)
        if figure == PATH:
            answer = path_distance(table, table.codes[part, 3], table.codes[part, 4], p)
        elif figure == CIRCLE:
            # length - radius as a difference of squares, accurate in float32 for large circles.
            offset = p - first
            length = wp.length(offset)
            answer[2] = (wp.dot(p, p - first - first) + fourth) / (length + third)
            if length > zero:
                answer = triple(offset[0] / length, offset[1] / length, answer[2])
        else:
            height = wp.dot(first, p) - third
            side = one
            if figure == BAND and height < zero:
                side = -one
            # A half-plane has no width: its fourth value is 0.
            answer = triple(side * first[0], side * first[1], side * height - fourth)
        if view == PLAN:
            return quad(answer[0], answer[1], zero, answer[2])
        return quad(answer[0] * spoke[0], answer[0] * spoke[1], answer[1], answer[2])

    @wp.func
    def intersection(here: quad, other: quad, radius: real, cosine: real):
        # See sim.indenters.indenter._intersection.
        a, b = here[3] + radius, other[3] + radius
        along_a, along_b = a - cosine * b, b - cosine * a
        sine2 = one - cosine * cosine
        length = wp.sqrt(wp.max(a * along_a + b * along_b, zero) / sine2)
        if along_a > zero and along_b > zero and length > zero:
            edge = (here * along_a + other * along_b) / (sine2 * length)
            normal = triple(edge[0], edge[1], edge[2])
            steepness = wp.length(normal)
            if steepness > real(STEEPNESS_MIN):
                normal /= steepness
                return quad(normal[0], normal[1], normal[2], (length - radius) / steepness)
        return wp.where(other[3] > here[3], other, here)

    @wp.func
    def parts_distance(table: table_type, indenter: int, x: triple):
        part = table.first[indenter]
        joined = part_distance(table, part, x)
        for k in range(part + 1, table.first[indenter + 1]):
            other = part_distance(table, k, x)
            join = table.codes[k, 2]
            if join == UNION:
                joined = wp.where(other[3] < joined[3], other, joined)
            else:
                if join == SUBTRACT:
                    other = -other
                joined = intersection(
                    joined, other, table.edge_radius[indenter], table.numbers[k, 6]
                )
        return joined

    return parts_distance


# Gap above which the distance from the bounding box, a lower bound, replaces the true one [m].
FAR = 1e-3
# Codes of a part: view, figure, join, its rows; its numbers: four values, the axis in x and y, the
# cosine.
CODES, NUMBERS = 5, 7
# Index of the first coefficient of an indenter without a field.
NOWHERE = -1

# Indices of a part's values that are lengths; the first two are a normal in the first two cases.
SCALED = {"half_plane": (2,), "band": (2, 3), "circle": (0, 1, 2), "path": ()}


@dataclass(frozen=True, slots=True)
class IndenterTraits:
    """Optional features of the indenters of a launch, compiled in on demand."""

    tilted: bool = False
    """True if any indenter is tilted."""
    sampled: bool = False
    """True if any indenter is a body from a file."""


PLAIN = IndenterTraits()


def traits_of(indenters: Sequence[Indenter]) -> IndenterTraits:
    """Return the features that kernels need for these indenters."""
    return IndenterTraits(
        tilted=any(one is not one.upright for one in indenters),
        sampled=any(one.solid is not None for one in indenters),
    )


@dataclass(frozen=True, slots=True)
class PartTable:
    """Indenters as arrays on a device, one per environment; equal ones are stored once."""

    struct: Any
    """Table for the function from `distance_function`."""
    traits: IndenterTraits
    """Traits for `distance_function`."""

    @classmethod
    def pack(
        cls,
        indenters: Sequence[Indenter],
        unit: float,
        real: type,
        device: Any = None,
        *,
        far: float = FAR,
    ) -> "PartTable":
        """Return the table of indenters, one per environment, with lengths in multiples of `unit`.

        `unit` and `far` are in [m]; `real` is wp.float32 or wp.float64. Gaps above `far` may be
        underestimated, but never below `far`.
        """
        kinds = list(dict.fromkeys(indenters))
        number = {kind: index for index, kind in enumerate(kinds)}
        first, codes, numbers = [0], [], []
        paths = [np.zeros((0, ROW))]
        row = 0
        for kind in kinds:
            for part in kind.parts:
                if part.figure == "path":
                    paths.append(rows(part.values, kind.edge_radius))
                last = row + len(paths[-1]) if part.figure == "path" else row
                names = VIEWS.index(part.view), FIGURES.index(part.figure), JOINS.index(part.join)
                codes.append((*names, row, last))
                row = last
                numbers.append(_numbers(part, unit))
            first.append(len(codes))
        path = np.concatenate(paths)
        path[:, [1, 2, 5]] /= unit
        point = max(POINT / unit, 8 * float(np.finfo(wp.dtype_to_numpy(real)).eps))

        def array(values: Any, dtype: Any) -> Any:
            return wp.array(values, dtype=dtype, device=device)

        traits = traits_of(kinds)
        struct = table_struct(real, traits)()
        struct.indenter = array([number[one] for one in indenters], int)
        struct.first = array(first, int)
        struct.edge_radius = array([kind.edge_radius / unit for kind in kinds], real)
        struct.box = array([np.ravel(kind.upright.bounds) / unit for kind in kinds], real)
        struct.codes = array(np.reshape(codes, (-1, CODES)), int)
        struct.numbers = array(np.reshape(numbers, (-1, NUMBERS)), real)
        struct.path = array(path, real)
        struct.far, struct.point = real(far / unit), real(point)
        if traits.tilted:
            turns, raised = zip(*(kind.stance for kind in kinds), strict=True)
            struct.turn = array(np.stack(turns), wp.types.matrix((3, 3), real))
            struct.raised = array(np.array(raised) / unit, real)
        if traits.sampled:
            for name, (values, dtype) in _fields(kinds, unit, real).items():
                setattr(struct, name, array(values, dtype))
        return cls(struct, traits)


def _numbers(part: Any, unit: float) -> list[float]:
    values = [] if part.figure == "path" else list(part.values)
    for index in SCALED[part.figure]:
        values[index] /= unit
    if part.figure == "circle":
        # |centre|^2 - radius^2, exact if the circle passes through the tip.
        values.append(values[0] ** 2 + values[1] ** 2 - values[2] ** 2)
    values += [0.0] * (4 - len(values))
    return [*values, part.axis[0] / unit, part.axis[1] / unit, part.cosine]


def _fields(kinds: Sequence[Indenter], unit: float, real: type) -> dict[str, tuple[Any, Any]]:
    """Return the struct's arrays for bodies from files; tilts of the same body share a field."""
    firsts, sizes, layouts = [], [], []
    first_of, values, count = {}, [], 0
    for kind in kinds:
        first, size, layout = NOWHERE, (0, 0, 0), (0.0, 0.0, 0.0, 1.0)
        if kind.solid is not None:
            field = kind.solid.distances(kind.edge_radius)
            if kind.upright not in first_of:
                first_of[kind.upright] = count
                values.append(field.coefficients.ravel() / unit)
                count += field.grid.count
            first, size = first_of[kind.upright], field.grid.shape
            layout = (*(field.origin / unit), field.grid.spacing / unit)
        firsts.append(first)
        sizes.append(size)
        layouts.append(layout)
    return {
        "field_first": (firsts, int),
        "field_size": (sizes, int),
        "field_place": (layouts, real),
        "field": (np.concatenate(values), real),
    }


@cache
def table_struct(real: type, traits: IndenterTraits) -> Any:
    """Return the Warp struct that holds indenters as arrays of `real`, lengths in one unit."""

    class IndenterTable:
        # Per environment: index of the indenter.
        indenter: wp.array[int]
        # Per indenter (one more in `first`): first part, edge radius, box (x, y, z pairs).
        first: wp.array[int]
        edge_radius: wp.array[real]
        box: wp.array2d[real]
        # Per part: view, figure, join, first row and end of its path; then its numbers.
        codes: wp.array2d[int]
        numbers: wp.array2d[real]
        # Rows of paths, as in `outline.rows`.
        path: wp.array2d[real]
        # Gap above which a lower bound suffices; length below which there is no direction.
        far: real
        point: real

    fields, name = IndenterTable.__annotations__, f"IndenterTable_{real.__name__}"
    if traits.tilted:
        # Per indenter: rotation of its tilt, and the height by which it is raised.
        fields |= {"turn": wp.array[wp.types.matrix((3, 3), real)], "raised": wp.array[real]}
        name += "_tilted"
    if traits.sampled:
        # Per indenter: index of its first coefficient, nodes along each axis, position of the first
        # node and spacing; then all coefficients.
        fields |= {"field_first": wp.array[int], "field_size": wp.array2d[int]}
        fields |= {"field_place": wp.array2d[real], "field": wp.array[real]}
        name += "_sampled"
    # Warp distinguishes structs by their names.
    IndenterTable.__qualname__ = name
    return wp.struct(IndenterTable)


@cache
def distance_function(real: type, traits: IndenterTraits) -> Any:
    """Return the Warp function (table, environment, point) -> (normal x, y, z, gap).

    Lengths are in the table's unit. It is the same as `Indenter.distance`, except beyond the
    table's `far`, where the gap may be smaller than the true one and the normal is that of a side
    of the bounding box. `traits` are the table's; unused features are compiled out.
    """
    table_type = table_struct(real, traits)
    parts_distance = parts_function(real, table_type)
    field_distance = field_function(real, table_type) if traits.sampled else None
    triple = wp.types.vector(3, real)
    quad = wp.types.vector(4, real)
    zero, one = real(0.0), real(1.0)

    @wp.func
    def upright_distance(table: table_type, indenter: int, x: triple):
        bound = quad(zero, zero, -one, table.box[indenter, 4] - x[2])
        for axis in range(2):
            for end in range(2):
                sign = real(2 * end - 1)
                beyond = sign * (x[axis] - table.box[indenter, 2 * axis + end])
                if beyond > bound[3]:
                    bound = quad(zero, zero, zero, beyond)
                    bound[axis] = sign
        if bound[3] > table.far:
            return bound
        if wp.static(traits.sampled):
            first = table.field_first[indenter]
            if first >= 0:
                return field_distance(table, indenter, x)
        return parts_distance(table, indenter, x)

    @wp.func
    def distance(table: table_type, environment: int, x: triple):
        indenter = table.indenter[environment]
        if wp.static(traits.tilted):
            turn = table.turn[indenter]
            place = x - triple(zero, zero, table.raised[indenter])
            answer = upright_distance(table, indenter, wp.transpose(turn) * place)
            normal = turn * triple(answer[0], answer[1], answer[2])
            return quad(normal[0], normal[1], normal[2], answer[3])
        return upright_distance(table, indenter, x)

    return distance
