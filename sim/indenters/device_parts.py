# mypy: ignore-errors
# (Warp reads the annotations of its functions as values, which no type checker follows.)
"""The signed distance to a fold of parts on the device, as `Indenter.distance` has it."""

from typing import Any

import warp as wp

from sim.indenters.indenter import STEEPNESS_MIN
from sim.indenters.outline_distance import ARC, LINE
from sim.indenters.part import FIGURES, JOINS, VIEWS

PLAN, TURNED = VIEWS.index("plan"), VIEWS.index("turned")
BAND, CIRCLE, PATH = (FIGURES.index(name) for name in ("band", "circle", "path"))
UNION, SUBTRACT = JOINS.index("union"), JOINS.index("subtract")


def parts_function(real: type, table_type: Any) -> Any:
    """The Warp function (table, indenter, point) -> (normal x, y, z, gap) of a fold of parts."""
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
    def parts_distance(table: table_type, indenter: int, x: triple):
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

    return parts_distance
