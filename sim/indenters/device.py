# mypy: ignore-errors
# (Warp reads the annotations of its functions as values, which no type checker follows.)
"""The signed distance on the device: one table of numbers, any indenter in any environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from sim.indenters.indenter import STEEPNESS_MIN, Indenter
from sim.indenters.outline import POINT
from sim.indenters.outline_distance import ARC, LINE, ROW, rows
from sim.indenters.part import FIGURES, JOINS, VIEWS

FAR = 1e-3
"""Gaps beyond this may be given too small [m]: the distance from the bounding box serves."""
NUMBERS = 7
"""Numbers of a part: four values, the axis in x and y, the cosine."""

PLAN, TURNED = VIEWS.index("plan"), VIEWS.index("turned")
BAND, CIRCLE, PATH = (FIGURES.index(name) for name in ("band", "circle", "path"))
UNION, SUBTRACT = JOINS.index("union"), JOINS.index("subtract")
# Which of a part's four values are lengths; the first two are a normal in the first two cases.
SCALED = {"half_plane": (2,), "band": (2, 3), "circle": (0, 1, 2), "path": ()}


@dataclass(frozen=True, slots=True)
class PartTable:
    """Indenters as arrays on a device, one for each environment; equal ones are stored once."""

    struct: Any
    """What `distance_function` takes as its table."""
    count: int
    """Number of environments."""

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
        """The table of these indenters, one an environment, with lengths in multiples of `unit`.

        `unit` and `far` are in [m]; `real` is wp.float32 or wp.float64. Gaps above `far` may be
        given too small, never below `far`.
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

        struct = table_struct(real)()
        struct.indenter = array([number[one] for one in indenters], int)
        struct.first = array(first, int)
        struct.edge_radius = array([kind.edge_radius / unit for kind in kinds], real)
        struct.box = array([np.ravel(kind.bounds) / unit for kind in kinds], real)
        struct.codes = array(codes, int)
        struct.numbers = array(numbers, real)
        struct.path = array(path, real)
        struct.far, struct.point = real(far / unit), real(point)
        return cls(struct=struct, count=len(indenters))


def _numbers(part: Any, unit: float) -> list[float]:
    values = [] if part.figure == "path" else list(part.values)
    for index in SCALED[part.figure]:
        values[index] /= unit
    if part.figure == "circle":
        # |centre|^2 - radius^2, exact where the circle passes through the tip.
        values.append(values[0] ** 2 + values[1] ** 2 - values[2] ** 2)
    values += [0.0] * (4 - len(values))
    return [*values, part.axis[0] / unit, part.axis[1] / unit, part.cosine]


@cache
def table_struct(real: type) -> Any:
    """The Warp struct that holds indenters as arrays of `real`, lengths in one unit."""

    class IndenterTable:
        # Per environment: which indenter.
        indenter: wp.array[int]
        # Per indenter (one more in `first`): its first part, its radius, its box (x, y, z pairs).
        first: wp.array[int]
        edge_radius: wp.array[real]
        box: wp.array2d[real]
        # Per part: view, figure, join, first row and end of its path; then its numbers.
        codes: wp.array2d[int]
        numbers: wp.array2d[real]
        # Rows of paths, as in outline_distance.rows.
        path: wp.array2d[real]
        # Where a bound is enough; what is too short to have a direction.
        far: real
        point: real

    # Warp tells structs apart by their names.
    IndenterTable.__qualname__ = f"IndenterTable_{real.__name__}"
    return wp.struct(IndenterTable)


@cache
def distance_function(real: type) -> Any:
    """The Warp function (table, environment, point) -> (normal x, y, z, gap), lengths in the unit.

    The same as `Indenter.distance`, except beyond the table's `far`, where the gap may be smaller
    than the true one and the normal is a side of the bounding box.
    """
    table_type = table_struct(real)
    pair = wp.types.vector(2, real)
    triple = wp.types.vector(3, real)
    quad = wp.types.vector(4, real)
    zero, one = real(0.0), real(1.0)

    @wp.func
    def path_distance(table: table_type, row: int, end: int, p: pair):
        # The nearest piece wins; corners come last and count only where nearer than all pieces.
        found = triple(one, zero, real(wp.inf))
        for k in range(row, end):
            kind = int(table.path[k, 0])
            along = pair(table.path[k, 3], table.path[k, 4])
            size = table.path[k, 5]
            offset = p - pair(table.path[k, 1], table.path[k, 2])
            facing = wp.dot(along, offset)
            normal = pair(along[1], -along[0])
            gap = wp.dot(normal, offset)
            nearer = facing >= zero and facing <= size and wp.abs(gap) < wp.abs(found[2])
            if kind != LINE:
                length = wp.length(offset)
                side = wp.where(facing < zero, -one, one)
                gap = side * length
                nearer = length < wp.abs(found[2]) - table.point
                if kind == ARC:
                    side = wp.where(size < zero, -one, one)
                    gap = side * length - size
                    nearer = facing >= table.path[k, 6] * length and wp.abs(gap) < wp.abs(found[2])
                normal = along
                if length > table.point:
                    normal = offset * (side / length)
            if nearer:
                found = triple(normal[0], normal[1], gap)
        return found

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
        found = triple(one, zero, zero)
        if figure == PATH:
            found = path_distance(table, table.codes[part, 3], table.codes[part, 4], p)
        elif figure == CIRCLE:
            # length - radius, as a difference of squares: a large circle keeps float32's digits.
            offset = p - first
            length = wp.length(offset)
            found[2] = (wp.dot(p, p - first - first) + fourth) / (length + third)
            if length > zero:
                found = triple(offset[0] / length, offset[1] / length, found[2])
        else:
            height = wp.dot(first, p) - third
            side = one
            if figure == BAND and height < zero:
                side = -one
            # A half-plane has no width: its fourth value is 0.
            found = triple(side * first[0], side * first[1], side * height - fourth)
        if view == PLAN:
            return quad(found[0], found[1], zero, found[2])
        return quad(found[0] * spoke[0], found[0] * spoke[1], found[1], found[2])

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
    def distance(table: table_type, environment: int, x: triple):
        indenter = table.indenter[environment]
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
        part = table.first[indenter]
        found = part_distance(table, part, x)
        for k in range(part + 1, table.first[indenter + 1]):
            other = part_distance(table, k, x)
            join = table.codes[k, 2]
            if join == UNION:
                found = wp.where(other[3] < found[3], other, found)
            else:
                if join == SUBTRACT:
                    other = -other
                found = intersection(found, other, table.edge_radius[indenter], table.numbers[k, 6])
        return found

    return distance
