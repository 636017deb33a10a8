# mypy: ignore-errors
# (Warp reads the annotations of its functions as values, which no type checker follows.)
"""The signed distance to a body from a file on the device, as `Field.distance` has it."""

from typing import Any

import warp as wp

from sim.indenters.field import FLAT

TAPS = 4
"""Nodes that a cubic spline feels along each axis."""


def field_function(real: type, table_type: Any) -> Any:
    """The Warp function (table, indenter, point) -> (normal x, y, z, gap) of a tricubic spline."""
    triple = wp.types.vector(3, real)
    quad = wp.types.vector(4, real)
    zero, one, two, three, six = (real(value) for value in (0.0, 1.0, 2.0, 3.0, 6.0))
    four, flat = real(4.0), real(FLAT)

    @wp.func
    def weights(share: real):
        left = one - share
        return quad(
            left * left * left / six,
            (four + share * share * (three * share - six)) / six,
            (four + left * left * (three * left - six)) / six,
            share * share * share / six,
        )

    @wp.func
    def slopes(share: real):
        left = one - share
        return quad(
            -left * left / two,
            share * (three * share - four) / two,
            -left * (three * left - four) / two,
            share * share / two,
        )

    @wp.func
    def field_distance(table: table_type, indenter: int, x: triple):
        spacing = table.field_place[indenter, 3]
        ny, nz = table.field_size[indenter, 1], table.field_size[indenter, 2]
        node = wp.vec3i()
        share = triple()
        beyond = triple()
        for axis in range(3):
            place = (x[axis] - table.field_place[indenter, axis]) / spacing
            held = wp.clamp(place, one, real(table.field_size[indenter, axis] - 3))
            node[axis] = int(held)
            share[axis] = held - real(node[axis])
            beyond[axis] = (place - held) * spacing
        corner = ((node[0] - 1) * ny + node[1] - 1) * nz + node[2] - 1
        start = table.field_first[indenter] + corner
        beyond[2] = wp.min(beyond[2], zero)
        along_x, along_y, along_z = weights(share[0]), weights(share[1]), weights(share[2])
        slope_x, slope_y, slope_z = slopes(share[0]), slopes(share[1]), slopes(share[2])
        gap = zero
        gradient = triple()
        # A bound that changes: unrolled, these loops would be 64 bodies at every call.
        taps = int(TAPS)
        for i in range(taps):
            for j in range(taps):
                row = start + (i * ny + j) * nz
                value = zero
                upward = zero
                for k in range(TAPS):
                    taken = table.field[row + k]
                    value += along_z[k] * taken
                    upward += slope_z[k] * taken
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
