# mypy: ignore-errors
# (Warp reads the annotations of its functions as values, which no type checker follows.)
"""The signed distance on the device: one table of numbers, any indenter in any environment."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp

from sim.indenters.device_field import field_function
from sim.indenters.device_parts import parts_function
from sim.indenters.indenter import Indenter
from sim.indenters.outline import POINT
from sim.indenters.outline_distance import ROW, rows
from sim.indenters.part import FIGURES, JOINS, VIEWS

FAR = 1e-3
"""Gaps beyond this may be given too small [m]: the distance from the bounding box serves."""
CODES, NUMBERS = 5, 7
"""Codes of a part: view, figure, join, its rows; its numbers: four values, the axis in x and y,
the cosine."""
NOWHERE = -1
"""First number of the field of an indenter that has none."""

# Which of a part's four values are lengths; the first two are a normal in the first two cases.
SCALED = {"half_plane": (2,), "band": (2, 3), "circle": (0, 1, 2), "path": ()}


@dataclass(frozen=True, slots=True)
class Traits:
    """What the indenters of a launch have of which others know nothing, compiled in on demand."""

    tilted: bool = False
    """Some lean."""
    sampled: bool = False
    """Some are bodies from files."""


PLAIN = Traits()


def traits_of(indenters: Sequence[Indenter]) -> Traits:
    """What the kernels have to know for these indenters."""
    return Traits(
        tilted=any(one is not one.upright for one in indenters),
        sampled=any(one.solid is not None for one in indenters),
    )


@dataclass(frozen=True, slots=True)
class PartTable:
    """Indenters as arrays on a device, one for each environment; equal ones are stored once."""

    struct: Any
    """What `distance_function` takes as its table."""
    count: int
    """Number of environments."""
    traits: Traits
    """Which `distance_function` takes it."""

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
        return cls(struct=struct, count=len(indenters), traits=traits)


def _numbers(part: Any, unit: float) -> list[float]:
    values = [] if part.figure == "path" else list(part.values)
    for index in SCALED[part.figure]:
        values[index] /= unit
    if part.figure == "circle":
        # |centre|^2 - radius^2, exact where the circle passes through the tip.
        values.append(values[0] ** 2 + values[1] ** 2 - values[2] ** 2)
    values += [0.0] * (4 - len(values))
    return [*values, part.axis[0] / unit, part.axis[1] / unit, part.cosine]


def _fields(kinds: Sequence[Indenter], unit: float, real: type) -> dict[str, tuple[Any, Any]]:
    """What the struct holds of bodies from files; kinds that only lean differently share one."""
    firsts, sizes, places = [], [], []
    known, values, count = {}, [], 0
    for kind in kinds:
        first, size, place = NOWHERE, (0, 0, 0), (0.0, 0.0, 0.0, 1.0)
        if kind.solid is not None:
            field = kind.solid.distances(kind.edge_radius)
            if kind.upright not in known:
                known[kind.upright] = count
                values.append(field.coefficients.ravel() / unit)
                count += field.grid.count
            first, size = known[kind.upright], field.grid.shape
            place = (*(field.origin / unit), field.grid.spacing / unit)
        firsts.append(first)
        sizes.append(size)
        places.append(place)
    return {
        "field_first": (firsts, int),
        "field_size": (sizes, int),
        "field_place": (places, real),
        "field": (np.concatenate(values), real),
    }


def table_struct(real: type, traits: Traits = PLAIN) -> Any:
    """The Warp struct that holds indenters as arrays of `real`, lengths in one unit."""
    return _table_struct(real, traits)


@cache
def _table_struct(real: type, traits: Traits) -> Any:
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

    fields, name = IndenterTable.__annotations__, f"IndenterTable_{real.__name__}"
    if traits.tilted:
        # Per indenter: how it leans, and how far it is raised for that.
        fields |= {"turn": wp.array[wp.types.matrix((3, 3), real)], "raised": wp.array[real]}
        name += "_tilted"
    if traits.sampled:
        # Per indenter: its first coefficient, nodes along each axis, the first node's place and
        # the spacing; then the coefficients of all.
        fields |= {"field_first": wp.array[int], "field_size": wp.array2d[int]}
        fields |= {"field_place": wp.array2d[real], "field": wp.array[real]}
        name += "_sampled"
    # Warp tells structs apart by their names.
    IndenterTable.__qualname__ = name
    return wp.struct(IndenterTable)


def distance_function(real: type, traits: Traits = PLAIN) -> Any:
    """The Warp function (table, environment, point) -> (normal x, y, z, gap), lengths in the unit.

    The same as `Indenter.distance`, except beyond the table's `far`, where the gap may be smaller
    than the true one and the normal is a side of the bounding box. `traits` are the table's; of
    what no indenter has there is no trace in the function.
    """
    return _distance_function(real, traits)


@cache
def _distance_function(real: type, traits: Traits) -> Any:
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
            found = upright_distance(table, indenter, wp.transpose(turn) * place)
            normal = turn * triple(found[0], found[1], found[2])
            return quad(normal[0], normal[1], normal[2], found[3])
        return upright_distance(table, indenter, x)

    return distance
