"""Presses without a solver: superposed from a ladder of solved ones, per indenter and skin.

    ladder = Ladder.of("prism", sensor("r6"))
    press = LadderPress(ladder, friction=0.5)
    press.move(np.array([0.0, 0.0, -1e-3]), 0.2)
    press.wrench, press.markers(points)

A `Ladder` is a few normal presses by tier `layer`, each deeper than the one before. Everything
else is superposed. In shear a contact of rising pressure p(d) slips from its rim inwards, and its
shear traction is mu (p(d) - p(d*)): that of a deeper press less that of a lighter one (Jaeger,
J. Tribol. 120 (1998) 677; Ciavarella, Int. J. Solids Struct. 35 (1998) 2349). As a sum over the
steps of the ladder these are springs side by side, each with a slider of Coulomb's limit (Iwan,
J. Appl. Mech. 33 (1966) 893): a press keeps one force per slider, and loading, unloading and turns
follow Masing's rule without a case for each. How far it is off: docs/reference/fidelity.md.
"""

from __future__ import annotations

import hashlib
import io
import math
import os
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PchipInterpolator

from sim.indenters import Indenter, named
from sim.scene import Body, Effects, Friction, Motion, Scene, Viscosity
from sim.sensors import SimulatedSensor

if TYPE_CHECKING:
    from sim.layer.spectral import PixelGrid

Array = NDArray[np.floating[Any]]

# Presses of a ladder, and the power of their number with which the depth grows.
STEPS, POWER = 16, 1.3
# Deepest press over the sensor's depth.
BEYOND = 1.15
# Pixels across the body, residual of the contact, and friction of the presses.
GRID, TOLERANCE, FRICTION = 128, 2e-3, 0.5
# Level of no traction along x, y and z in files.
ZERO = np.array([127, 127, 255])[:, None, None]
# Pixels per point of the displacement fields along an axis.
COARSE = 2
# Least growth of the tangential stiffness from one step to the next, over the stiffness.
LEAST = 1e-3
# Motion of skin along its slope beside a contact, over the depth (`_drawn`).
DRAWN = 0.25
# Force of a skin that counts as recovered [N].
RESTED = 1e-6
# Error of a force by a table of `fem`, beside that of the table, over the force; and the least one
# of an indenter without a table, for which the middle of the others stands in.
INTERPOLATED, ANOTHER = 0.03, 0.15
# Difference of a body's sides from those of a table, over them, up to which its walls move the top
# as that body's.
STRETCHED = 0.15
# Ladders that come with the simulator, and `fem` against them: two files per skin.
PACKAGED = Path(__file__).parent / "ladders"
NUMBERS = "depth", "ratio", "error", "side"
# Distances from a contact's middle, over that of the wall, at which `ByFem.shear` is known.
APART = np.array([0.0, 0.15, 0.3, 0.45, 0.6, 0.8, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Presses:
    """Normal presses of one indenter into a skin of modulus 1 Pa; n steps, from light to deep."""

    depth: Array
    """Depth of the tip (n,) [m]."""
    wrench: Array
    """Force and torque about the tip, on the body (n, 6) [N, N m]."""
    height: Array
    """Mean height of the pressed skin above the tip, weighted by pressure (n,) [m]."""
    traction: Array
    """Traction on the body (n, 3, X, Y) [Pa]."""

    @classmethod
    def read(cls, file: Mapping[str, Any], key: str = "") -> Self:
        """Return the presses of `packed`, whose names begin with `key`."""
        low, high, shape = file[f"{key}window"]
        levels = file[f"{key}levels"].astype(np.float32)
        traction = np.zeros((*levels.shape[:2], *shape), np.float32)
        traction[..., low[0] : high[0], low[1] : high[1]] = (levels - ZERO) * file[f"{key}unit"]
        depth, wrench, height = (file[f"{key}{name}"] for name in ("depth", "wrench", "height"))
        return cls(depth, wrench, height, traction)

    def packed(self, key: str = "") -> dict[str, Any]:
        """Return arrays for a file; tractions have 8 bits and are cut to where they are."""
        touched = np.argwhere(self.traction.any(axis=(0, 1)))
        low, high = touched.min(axis=0), touched.max(axis=0) + 1
        some = self.traction[..., low[0] : high[0], low[1] : high[1]]
        unit = np.maximum(np.abs(some).max(axis=(2, 3), keepdims=True), 1e-30) / ZERO
        arrays = {
            "depth": self.depth,
            "wrench": self.wrench,
            "height": self.height,
            "window": np.stack([low, high, self.traction.shape[2:]]),
            "levels": np.round(some / unit + ZERO).astype(np.uint8),
            "unit": unit.astype(np.float32),
        }
        return {f"{key}{name}": array for name, array in arrays.items()}


@dataclass(frozen=True, slots=True, eq=False)
class ByFem:
    """Force, stiffness and surface by `fem` against those of a ladder's presses, at k depths."""

    depth: Array
    """Depth of the tip (k,) [m]."""
    ratio: Array
    """Force by `fem` over that of the presses (k,)."""
    error: Array
    """Stated error of the force, over it (k,)."""
    side: float = 1.0
    """Tangential stiffness by `fem` over that of the presses, beyond the ratio of forces."""
    moved: Array | None = None
    """Displacement of the top by `fem` less that by the presses, over the depth (k, m, m, 3), at
    places evenly spaced across the body; None: unknown."""
    shear: Array | None = None
    """The same in shear, for all indenters of a skin, over s, the side force over modulus and
    thickness: along s, along (s e) e and along |s| e, where e points away from the middle, at
    distances `APART` (3, 7); None: unknown."""

    @classmethod
    def read(cls, file: Mapping[str, Any], key: str, *, whole: bool = True) -> Self:
        """Return what `packed` has written; `moved` only if `whole`."""
        depth, ratio, error, side = (file[f"{key}.{name}"] for name in NUMBERS)
        moved = file[f"{key}.levels"] * file[f"{key}.unit"] if whole else None
        return cls(depth, ratio, error, float(side), moved, file["shear"])

    def packed(self, key: str) -> dict[str, Any]:
        """Return arrays for a file; displacements have 8 bits."""
        arrays = {name: np.asarray(getattr(self, name), np.float32) for name in NUMBERS}
        if self.moved is not None:
            unit = np.abs(self.moved).max(axis=(1, 2), keepdims=True) / 127 + 1e-12
            arrays["levels"] = np.round(self.moved / unit).astype(np.int8)
            arrays["unit"] = unit.astype(np.float32)
        return {f"{key}.{name}": array for name, array in arrays.items()}

    def at(self, depths: Array) -> tuple[Array, Array]:
        """Return ratio and error at some depths [m]."""
        ratio, error = (np.interp(depths, self.depth, one) for one in (self.ratio, self.error))
        return ratio, error + np.maximum(depths / self.depth[-1] - 1, 0.0) / 2

    def moves(self, depth: float, points: Array) -> Array:
        """Return how `fem` moves points (p, 2) more than the presses at `depth` [m] (p, 3) [m].

        Points are places over half the body's side.
        """
        assert self.moved is not None
        field = interpolated(self.moved, *_place(self.depth, depth))
        places = np.linspace(-1.0, 1.0, field.shape[0])
        return depth * _bilinear(field, (places, places), np.clip(points, -1.0, 1.0))

    def drags(self, side: Array, points: Array) -> Array:
        """Return how `fem` moves points (p, 2) more under a side force (p, 2) [m].

        `side` is the force over modulus and thickness (2,) [m].
        """
        assert self.shear is not None
        apart = np.linalg.norm(points, axis=1)
        away = points / np.maximum(apart, 1e-9)[:, None]
        along, turned, out = (np.interp(apart, APART, part)[:, None] for part in self.shear)
        turned = turned * (away @ side)[:, None]
        return np.asarray(along * side + (turned + out * np.linalg.norm(side)) * away)


# Nothing added.
BARE = ByFem(np.ones(1), np.ones(1), np.full(1, 2 * ANOTHER))


class Ladder:
    """Presses of an indenter into a skin at the top's middle, and the fields of its surface.

    Stiffness sideways and the surface are computed when they are first used: the force alone needs
    neither.
    """

    def __init__(self, presses: Presses, body: Body, by_fem: ByFem) -> None:
        """Superpose presses into the skin of a body, mended by `fem`."""
        self.body = body
        self.depths: Array = np.concatenate([[0.0], presses.depth])
        """Depths of the ladder, from 0 (n + 1,) [m]."""
        self.depth_max = float(self.depths[-1])
        """Depth of the deepest step [m]."""
        ratio, self._error = by_fem.at(presses.depth)
        self.by_fem = by_fem
        """Corrections by `fem`."""
        scale = ratio * body.modulus
        self._presses, self._side_scale = presses, by_fem.side * scale[:, None]
        self._forces = np.concatenate([[0.0], -presses.wrench[:, 2] * scale])
        self._fine = np.linspace(0.0, 1.0, 8 * STEPS + 1) ** POWER * self.depth_max
        # Between rungs the force over a power of the depth changes little, down to no depth at all.
        lightest, next_ = self._forces[1:3]
        power = math.log(next_ / lightest) / math.log(self.depths[2] / self.depths[1])
        smooth = self._forces[1:] / self.depths[1:] ** power
        over_power = PchipInterpolator(self.depths, np.concatenate([smooth[:1], smooth]))
        self._fine_force = over_power(self._fine) * self._fine**power
        self._last = float(np.diff(self._fine_force[-2:])[0] / np.diff(self._fine[-2:])[0])
        pressed = -presses.wrench[:, 2:3]
        units = np.column_stack([presses.wrench / pressed, presses.height])
        self._units: Array = np.vstack([units[:1], units])

    @cached_property
    def fields(self) -> Fields:
        """Displacement of the top."""
        return Fields.of(self._presses, self.body, self.by_fem)

    @cached_property
    def _stiffness(self) -> Array:
        """Tangential stiffness of each contact along x, along y (n, 2) [N/m]."""
        stiffness = self.fields.stiffness * self._side_scale
        # Each is at least a little above the one before.
        least = 1.0 + LEAST * np.arange(len(stiffness))[:, None]
        return np.asarray(np.maximum.accumulate(stiffness / least) * least)

    @cached_property
    def spring(self) -> Array:
        """Stiffness of each spring (n,) [N/m]."""
        return np.diff(self._stiffness.mean(axis=1), prepend=0.0)

    @cached_property
    def sideways(self) -> Array:
        """Stiffness of each spring along x, along y (n, 2) [N/m]."""
        return np.diff(self._stiffness, axis=0, prepend=0.0)

    @cached_property
    def _travel(self) -> Array:
        """`travel` of each depth (n + 1,) [m]."""
        steps = np.diff(self._forces) / self._stiffness.mean(axis=1)
        return np.concatenate([[0.0], np.cumsum(steps)])

    @cached_property
    def _fine_travel(self) -> Array:
        return np.asarray(np.interp(self._fine_force, self._forces, self._travel))

    @cached_property
    def _last_travel(self) -> float:
        return self._last / float(self._stiffness[-1].mean())

    @cached_property
    def _sides(self) -> list[tuple[Array, Array]]:
        return _sides(self._presses, _skin(self.body))

    @property
    def start(self) -> Array:
        """Travel, as of `travel`, from which each spring is pressed (n,) [m]."""
        return self._travel[:-1]

    @classmethod
    def of(cls, indenter: Indenter | str, row: SimulatedSensor, keep: Path | None = None) -> Self:
        """Return the ladder of an indenter, by its name or itself, on a sensor's skin.

        It is read if it comes with the simulator or was kept, otherwise solved, in a few seconds,
        and kept. Skins that differ in their modulus only share a ladder.

        Args:
            indenter: Indenter, or the name of one of the paper's.
            row: Sensor with the skin.
            keep: Folder for ladders that are solved; None: the user's cache.

        Raises:
            SceneError: The name is unknown, or tier `layer` does not support the body.
            SimulationDiverged: A press has no solution.
        """
        shape = named(indenter) if isinstance(indenter, str) else indenter
        still = Motion(tip=((0.0, 0.0, 0.0),), time=(0.0,))
        felt = row.scene(shape, still).indenter
        presses = presses_of(felt, row, keep or cache_folder())
        return cls(presses, row.body, fem_of(name_of(felt, row.body), row.body))

    def normal(self, depth: float) -> float:
        """Return the static force at `depth` [m], in the top's middle [N]."""
        beyond = self._last * max(depth - self.depth_max, 0.0)
        return float(np.interp(depth, self._fine, self._fine_force)) + beyond

    def interval(self, depth: float) -> tuple[float, float]:
        """Return the least and the largest force expected at `depth` [m] [N]."""
        force, error = self.normal(depth), float(np.interp(depth, self.depths[1:], self._error))
        error *= max(1.0, depth / self.depth_max) ** 2
        return max(0.0, 1 - error) * force, (1 + error) * force

    def deepest(self, force: float) -> float:
        """Return the depth at which the static force reaches `force` [N] [m]."""
        beyond = max(force - float(self._forces[-1]), 0.0) / self._last
        return float(np.interp(force, self._fine_force, self._fine)) + beyond

    def travel(self, depth: float | Array) -> Array:
        """Return how far a contact at `depth` [m] moves sideways until all of it slips [m].

        Over the coefficient of friction.
        """
        beyond = self._last_travel * np.maximum(depth - self.depth_max, 0.0)
        return np.asarray(np.interp(depth, self._fine, self._fine_travel) + beyond)

    def unit(self, depth: float) -> Array:
        """Return wrench over normal force, then the height of the pressed skin [m] (7,)."""
        return interpolated(self._units, *self.place(depth))

    def on_body(self, tip: Array) -> float:
        """Return the share of the force that the body bears under a tip at (3,) [m].

        The rest of the pressure is beside the body. That a skin is softer at its side is not in it.
        """
        fraction = 1.0
        at = max(0, min(int(np.searchsorted(self.depths, -tip[2])), len(self.start)) - 1)
        halves = self.body.size_x / 2, self.body.size_y / 2
        for place, half, (edges, below) in zip(tip[:2], halves, self._sides, strict=True):
            if abs(place) + edges[-1] > half:
                first, last = np.interp([-half - place, half - place], edges, below[at])
                fraction *= float(last - first)
        return fraction

    def place(self, depth: float) -> tuple[int, float]:
        """Return the step below `depth` [m] and the fraction of the way to the next one."""
        return _place(self.depths, depth)


def _place(depths: Array, depth: float) -> tuple[int, float]:
    """Return the one of some depths [m] below `depth`, and the fraction of the way to the next."""
    at = max(0, min(int(np.searchsorted(depths, depth)) - 1, len(depths) - 2))
    below, above = depths[at : at + 2]
    return at, min(max((depth - below) / (above - below), 0.0), 1.0)


def interpolated(values: Array, at: int, part: float) -> Array:
    """Return the values (n, ...) at a fraction `part` of the way from number `at` to the next."""
    return np.asarray((1 - part) * values[at] + part * values[at + 1])


@dataclass(frozen=True, slots=True, eq=False)
class Fields:
    """Displacement of the top by each step of a ladder, about the contact's middle."""

    x: Array
    """Places along x (X,) [m]."""
    y: Array
    """Places along y (Y,) [m]."""
    normal: Array
    """Displacement by each press, after none (n + 1, X, Y, 3) [m], float32."""
    sideways: Array
    """Displacement by the contact of each step that moves by 1 m along x, along y, less that of
    the step before (n, 2, X, Y, 3), float32."""
    rubbed: Array
    """Part of `normal` by the friction of pressing (n + 1, X, Y, 3) [m], float32."""
    stiffness: Array
    """Tangential stiffness of each contact along x, along y, for a modulus of 1 Pa (n, 2) [N/m]."""

    @classmethod
    def of(cls, presses: Presses, body: Body, by_fem: ByFem) -> Self:
        """Return the fields of some presses, mended by `fem`.

        A contact that moves sideways as a whole has the tractions by which its next step presses:
        those of a flat punch of its outline.
        """
        import scipy.fft

        from sim.layer.spectral import PixelGrid

        skin = _skin(body)
        grid = PixelGrid(skin, GRID)
        symbol = (skin.modulus * grid.symbol).astype(np.float32)
        traction = np.zeros((*presses.traction.shape[:2], *grid.period), np.float32)
        traction[..., : grid.shape[0], : grid.shape[1]] = presses.traction
        waves = scipy.fft.rfft2(traction)
        added = np.diff(-waves[:, 2], axis=0, prepend=0)
        pressed = np.diff(-presses.traction[:, 2].sum(axis=(1, 2)), prepend=0)
        twice = np.full(symbol.shape[2], 2.0)
        twice[0] = twice[-1] = 1.0
        # Mean displacement, weighted by the traction (n, 2), by Parseval's theorem.
        moved = np.einsum("nij,kij->nk", np.square(np.abs(added)) * twice, symbol[:2])
        moved /= np.prod(grid.period) * pressed[:, None]
        symbol, waves, added = (_long(one, grid) for one in (symbol, waves, added))
        normal = _displacement(grid, symbol, waves)
        waves[:, 2] = 0
        rubbed = _displacement(grid, symbol, waves)
        axes = np.zeros((2, len(added), 3, *added.shape[1:]), np.complex64)
        for k in (0, 1):
            axes[k, :, k] = added / moved[:, k, None, None]
        sideways = np.stack([_displacement(grid, symbol, axis) for axis in axes], axis=1)
        x, y = (
            (np.arange(count) - count / 2) * COARSE * pixel + pixel / 2
            for count, pixel in zip(normal.shape[1:3], grid.pixel, strict=True)
        )
        if by_fem.moved is None:
            free = np.ones(normal.shape[:3], bool)
            own = presses.traction[:, 2, ::COARSE, ::COARSE] == 0
            first = (len(x) - own.shape[1]) // 2
            second = (len(y) - own.shape[2]) // 2
            free[:, first : first + own.shape[1], second : second + own.shape[2]] = own
            normal[..., :2] += free[..., None] * _drawn(normal[..., 2], presses.depth, x, y)
        return cls(
            x,
            y,
            np.concatenate([np.zeros_like(normal[:1]), normal]),
            np.diff(sideways, axis=0, prepend=np.zeros_like(sideways[:1])),
            np.concatenate([np.zeros_like(rubbed[:1]), rubbed]),
            pressed[:, None] * grid.area / moved,
        )

    def at(self, field: Array, points: Array) -> Array:
        """Return a field (X, Y, 3) at points (m, 2) [m], 0 beyond its places (m, 3)."""
        return _bilinear(field, (self.x, self.y), points)


def _bilinear(field: Array, axes: tuple[Array, Array], points: Array) -> Array:
    """Return a field (X, Y, 3) with even axes at points (m, 2), 0 beyond its places (m, 3)."""
    value, inside = np.zeros((len(points), 3), np.float32), np.ones(len(points), bool)
    nodes, parts = [], []
    for axis, line in zip(axes, points.T, strict=True):
        position = (line - axis[0]) / (axis[1] - axis[0])
        inside &= (position >= 0) & (position <= len(axis) - 1)
        nodes.append(np.clip(position.astype(int), 0, len(axis) - 2))
        parts.append((position - nodes[-1])[:, None].astype(np.float32))
    for i in (0, 1):
        for j in (0, 1):
            weight = np.abs(1 - i - parts[0]) * np.abs(1 - j - parts[1])
            value += weight * field[nodes[0] + i, nodes[1] + j]
    value[~inside] = 0
    return value


def _drawn(dent: Array, depth: Array, x: Array, y: Array) -> Array:
    """Return how far skin is drawn under the indenter (n, X, Y, 2) [m], which `layer` leaves out.

    To second order in the depth d: -DRAWN (d + w) grad w / (1 + |grad w|^2) with the height w; a
    fit to `fem`. Contacts hold their skin.
    """
    slope = np.stack(list(np.gradient(dent, x, y, axis=(1, 2))), axis=-1)
    steep = 1 + np.square(slope).sum(axis=-1)
    return np.asarray(-DRAWN * ((depth[:, None, None] + dent) / steep)[..., None] * slope)


def _long(spectrum: NDArray[Any], grid: PixelGrid) -> NDArray[Any]:
    """Return the waves of (..., px, py // 2 + 1) that points of every `COARSE` pixels have."""
    low_x, low_y = (count // COARSE for count in grid.period)
    some = spectrum[..., : low_y // 2 + 1]
    return np.concatenate(
        [some[..., : (low_x + 1) // 2, :], some[..., -(low_x // 2) :, :]], axis=-2
    )


def _displacement(grid: PixelGrid, symbol: Array, waves: NDArray[Any]) -> Array:
    """Return the displacement (n, X, Y, 3) by tractions (n, 3, kx, ky), half a body beyond it."""
    import scipy.fft

    xx, yy, zz, xy = symbol[:4]
    xz, yz = 1j * symbol[4:]
    tx, ty, tz = np.moveaxis(waves, 1, 0)
    parts = (
        xx * tx + xy * ty + xz * tz,
        xy * tx + yy * ty + yz * tz,
        zz * tz - xz * tx - yz * ty,
    )
    low = tuple(count // COARSE for count in grid.period)
    whole = np.stack([scipy.fft.irfft2(part, s=low) for part in parts], axis=-1) / COARSE**2
    reach = [min(3 * n // (2 * COARSE), most) for n, most in zip(grid.shape, low, strict=True)]
    shift = [(far - n // COARSE) // 2 for far, n in zip(reach, grid.shape, strict=True)]
    moved = np.roll(whole, shift, (1, 2))[:, : reach[0], : reach[1]]
    return np.ascontiguousarray(moved, np.float32)


class LadderPress:
    """Press that follows a tip: forces and displacements by a ladder.

    Args:
        ladder: Solutions of the indenter and the skin.
        friction: Coulomb's coefficient; 0: none.
        viscosity: Relaxation of the skin; None: elastic.
    """

    def __init__(
        self, ladder: Ladder, friction: float = 0.0, viscosity: Viscosity | None = None
    ) -> None:
        self._ladder, self._friction = ladder, friction
        ratios, times = (viscosity.ratios, viscosity.times) if viscosity else ((), ())
        self._ratios, self._times = np.array(ratios, float), np.array(times, float)
        self._passed = self._passing(0.0)
        count = len(ladder.spring)
        self._elastic: Array = np.zeros((count, 3))
        """Force of each spring at rest: along x and y, and its pressure (n, 3) [N]."""
        self._branches: Array = np.zeros((len(ratios), count, 3))
        """Force of each spring in each branch (b, n, 3) [N]."""
        self._force: Array = np.zeros((count, 3))
        self._slipped: Array = np.zeros(count)
        """1 for each spring that slipped since it was pressed: there the friction of pressing gave
        way to that of the shear."""
        self.tip: Array = np.array([0.0, 0.0, np.inf])
        """Place of the tip in the contact frame (3,) [m]."""

    def move(self, tip: Array, seconds: float) -> None:
        """Move the tip straight to (3,) [m] in `seconds` [s]; 0 is a jump.

        The elastic force changes linearly within a move, as in `sim.layer.solver.History`.
        """
        tip = np.asarray(tip, float)
        aside = tip[:2] - self.tip[:2]
        self.tip = tip
        if tip[2] >= 0 and self._elastic[:, 2].sum() <= RESTED:
            self._elastic[:] = self._branches[:] = self._force[:] = 0.0
            return
        ladder = self._ladder
        factor, held = self._ahead(seconds)
        _, decay, gained = self._passed
        elastic = self._elastic.copy()
        elastic[:, :2] += ladder.sideways * aside
        pressed = np.maximum(ladder.travel(-tip[2]) - ladder.start, 0.0) if tip[2] < 0 else 0.0
        elastic[:, 2] = ladder.spring * pressed * ladder.on_body(tip)
        force = factor * elastic + held
        force[:, 2] = np.maximum(force[:, 2], 0.0)
        limit = self._friction * force[:, 2]
        length = np.hypot(force[:, 0], force[:, 1])
        self._slipped = np.where(length > limit, 1.0, self._slipped) * (limit > 0)
        force[:, :2] *= np.minimum(limit / np.maximum(length, 1e-30), 1.0)[:, None]
        elastic = (force - held) / factor
        change = elastic - self._elastic
        self._branches = decay * self._branches + gained * change
        self._elastic, self._force = elastic, force

    def slide(self, tip: Array, seconds: float) -> float:
        """Move the tip as `move`; return how far the part slid that sticks longest [m]."""
        before, aside = self.stuck, tip[:2] - self.tip[:2]
        self.move(tip, seconds)
        return math.hypot(*(aside - (self.stuck - before)))

    def _ahead(self, seconds: float) -> tuple[float, Array]:
        """Return the slope and the rest of each spring's force over its elastic one (n, 3) [N]."""
        if seconds != self._passed[0]:
            self._passed = self._passing(seconds)
        _, decay, gained = self._passed
        whole = gained.sum()
        return 1 + whole, (decay * self._branches).sum(axis=0) - whole * self._elastic

    def ahead(self, seconds: float) -> Ahead:
        """Return the forces that this press would have after a time [s]; nothing moves."""
        ladder, (factor, held) = self._ladder, self._ahead(seconds)
        spring = factor * ladder.on_body(self.tip) * ladder.spring
        side = factor * self._elastic[:, :2] + held[:, :2]
        stiffness = factor * ladder.sideways
        return Ahead(ladder, spring, held[:, 2], self._friction, side, stiffness)

    @property
    def stuck(self) -> Array:
        """Elastic displacement of the part of the contact that slips last (2,) [m]."""
        return np.asarray(self._elastic[0, :2] / self._ladder.sideways[0])

    def _passing(self, seconds: float) -> tuple[float, Array, Array]:
        """Return the time [s], and two factors of each branch over it (b, 1, 1).

        They are the fraction of its force that is left, and that of an elastic change it gains.
        """
        spans = (seconds / self._times)[:, None, None]
        ratios, whole = self._ratios[:, None, None], np.ones_like(spans)
        gained = np.divide(-np.expm1(-spans), spans, out=whole, where=spans > 0)
        return seconds, np.exp(-spans), ratios * gained

    @property
    def wrench(self) -> Array:
        """Force and torque of the indenter on the skin, about the tip (6,) [N, N m]."""
        along_x, along_y, pressed = self._force.sum(axis=0)
        if not pressed:
            return np.zeros(6)
        unit = self._ladder.unit(self._dent)
        wrench: Array = unit[:6] * pressed
        wrench[:3] = along_x, along_y, -pressed
        wrench[3:5] += -unit[6] * along_y, unit[6] * along_x
        return wrench

    @property
    def shear(self) -> Array:
        """Mean displacement of the contact sideways (2,) [m]; 0 without contact."""
        pressed = self._elastic[:, 2] > 0
        if not pressed.any():
            return np.zeros(2)
        stiffness = self._ladder.sideways[pressed].sum(axis=0)
        return np.asarray(self._elastic[:, :2].sum(axis=0) / stiffness)

    def markers(self, points: Array) -> Array:
        """Return the displacement (n, 3) [m] of the top at undeformed points (n, 2) [m]."""
        if not self._elastic.any():
            return np.zeros((len(points), 3), np.float32)
        ladder, fields = self._ladder, self._ladder.fields
        dent = self._dent
        place = ladder.place(dent)
        field = interpolated(fields.normal, *place)
        pressed = self._force[:, 2]
        slipped = float(pressed @ self._slipped) / max(float(pressed.sum()), 1e-30)
        if slipped:
            field -= slipped * interpolated(fields.rubbed, *place)
        sheared = self._elastic[:, :2] / ladder.sideways
        field += np.tensordot(sheared.astype(np.float32), fields.sideways, 2)
        aside = np.asarray(points, float) - self._middle
        moved = fields.at(field, aside)
        if ladder.by_fem.moved is not None:
            # Beside the contact as in the body's middle, and towards each wall as towards that.
            apart = self._over_walls(aside)
            part, half = np.abs(apart), np.array([ladder.body.size_x, ladder.body.size_y]) / 2
            moved += ladder.by_fem.moves(dent, (1 - part) * aside / half + part * apart)
        if ladder.by_fem.shear is not None:
            moved[:, :2] += self.dragged(points, ladder.by_fem)
        return moved

    def dragged(self, points: Array, by_fem: ByFem) -> Array:
        """Return how `by_fem` moves points (n, 2) [m] more in this shear (n, 2) [m]."""
        body = self._ladder.body
        side = self._elastic[:, :2].sum(axis=0) / (body.modulus * body.thickness)
        return by_fem.drags(side, self._over_walls(points - self._middle))

    def _over_walls(self, aside: Array) -> Array:
        """Return places (n, 2) [m] beside the contact's middle over the distances of the walls."""
        half = np.array([self._ladder.body.size_x, self._ladder.body.size_y]) / 2
        return np.asarray(aside / np.abs(np.where(aside < 0, -half, half) - self._middle))

    @property
    def _middle(self) -> Array:
        """Place of the contact's middle on the undeformed skin (2,) [m]."""
        return np.asarray(self.tip[:2] - self.shear)

    @property
    def _dent(self) -> float:
        """Depth of the skin under the tip [m]: deeper than the tip while it recovers."""
        return self._ladder.deepest(float(self._elastic[:, 2].sum()))


@dataclass(frozen=True, slots=True, eq=False)
class Ahead:
    """Forces of a press after a time, by where its tip is then; n springs."""

    _ladder: Ladder
    _spring: Array
    _rest: Array
    friction: float
    """Coulomb's coefficient."""
    side: Array
    """Side force of each spring at rest, not limited by friction (n, 2) [N]."""
    stiffness: Array
    """Growth of it over a move sideways in that time (n, 2) [N/m]."""

    def normal(self, depths: Array) -> Array:
        """Return the normal force of each spring at depths (k,) [m] (k, n) [N].

        The tip's place on the skin is that of the last move.
        """
        ladder = self._ladder
        travelled = np.maximum(ladder.travel(depths)[:, None] - ladder.start, 0.0)
        return np.maximum(self._spring * travelled + self._rest, 0.0)


# Presses by `layer` in files, and the corrections by `fem`.


def solved(felt: Indenter, body: Body, deepest: float) -> Presses:
    """Return the presses of an indenter into a skin down to `deepest` [m], by tier `layer`."""
    from sim.layer.solver import LayerPress
    from sim.layer.spectral import PixelGrid

    skin = _skin(body)
    depths = deepest * (np.arange(1, STEPS + 1) / STEPS) ** POWER
    way = Motion(((0.0, 0.0, 0.0), (0.0, 0.0, -deepest)), (0.0, 1.0))
    scene = Scene(felt, way, skin, Effects(Friction(FRICTION)))
    press = LayerPress(scene, PixelGrid(skin, GRID), TOLERANCE)
    wrench, height = np.zeros((STEPS, 6)), np.zeros(STEPS)
    traction = np.zeros((STEPS, 3, *press.grid.shape), np.float32)
    for step, depth in enumerate(depths):
        press.move(np.array([0.0, 0.0, -depth]), 1.0)
        pressure = -press.traction[2]
        wrench[step] = press.wrench / skin.modulus
        height[step] = depth + (pressure * press.displacement[2]).sum() / pressure.sum()
        traction[step] = press.traction / skin.modulus
    return Presses(depths, wrench, height, traction)


def presses_of(felt: Indenter, row: SimulatedSensor, keep: Path) -> Presses:
    """Return the presses of an indenter as the sensor's skin feels it."""
    key = name_of(felt, row.body)
    kept = keep / f"{key}.npz"
    for path, prefix in ((PACKAGED / f"{name_of_skin(row.body)}.npz", f"{key}."), (kept, "")):
        with suppress(OSError, KeyError, ValueError, zipfile.BadZipFile), np.load(path) as file:
            presses = Presses.read(file, prefix)
            if presses.depth[-1] >= row.depth_max:
                return presses
    packed = solved(felt, row.body, BEYOND * row.depth_max).packed()
    with suppress(OSError):  # then it is solved again the next time
        from recorder.store import replace_file

        kept.parent.mkdir(parents=True, exist_ok=True)
        data = io.BytesIO()
        np.savez_compressed(data, **packed)
        replace_file(kept, data.getvalue(), several=True)
    return Presses.read(packed)


def _skin(body: Body) -> Body:
    """Return the skin of modulus 1 kPa, square and at least as wide as any contact."""
    if body.dome_radius is not None:
        return replace(body, modulus=1e3)
    side = float(np.clip(5 * body.thickness, 20e-3, 40e-3))
    return Body(side, side, body.thickness, 1e3, body.poisson)


def name_of_skin(body: Body) -> str:
    """Return the name of a body's skin in files."""
    return f"{1e3 * body.thickness:g}mm-{body.poisson:g}"


def cache_folder() -> Path:
    """Return the user's folder for ladders."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "tactile-rig" / "ladders"


def name_of(felt: Indenter, body: Body) -> str:
    """Return the name of a ladder: a digest of all that it depends on."""
    if felt.solid is not None:
        felt = replace(felt, solid=replace(felt.solid, path="", notes=()))
    settings = (replace(felt, name=""), _skin(body), STEPS, POWER, GRID, TOLERANCE, FRICTION)
    return hashlib.sha256(repr(settings).encode()).hexdigest()[:12]


def fem_of(key: str, body: Body) -> ByFem:
    """Return the correction by `fem` of the ladder of that name on a body's skin.

    An indenter without a table has the middle of the others on such a skin.
    """
    path = PACKAGED / f"fem-{name_of_skin(body)}.npz"
    if not path.exists():
        return BARE
    with np.load(path) as file:
        names = [name.removesuffix(".depth") for name in file.files if name.endswith(".depth")]
        if key in names:
            sides = np.array([body.size_x, body.size_y]) / file["size"]
            own = ByFem.read(file, key, whole=bool((np.abs(sides - 1) < STRETCHED).all()))
            return replace(own, error=own.error + INTERPOLATED)
        others = [ByFem.read(file, name, whole=False) for name in names]
    depth = max((one.depth for one in others), key=lambda depth: float(depth[-1]))
    ratios = np.stack([np.interp(depth, one.depth, one.ratio) for one in others])
    middle = np.median(ratios, axis=0)
    error = np.maximum(np.abs(ratios / middle - 1).max(axis=0), ANOTHER)
    return ByFem(depth, middle, error, shear=others[0].shear)


def _sides(presses: Presses, skin: Body) -> list[tuple[Array, Array]]:
    """Return places [m] along x and y that enclose all contacts, and the share below each.

    Shares are those of the pressure of each press (n, places).
    """
    sides = []
    for other, size in ((2, skin.size_x), (1, skin.size_y)):
        pressure = -presses.traction[:, 2].sum(axis=other)
        below = np.pad(np.cumsum(pressure, axis=1), ((0, 0), (1, 0)))
        edges = np.linspace(-size / 2, size / 2, below.shape[1])
        touched = np.flatnonzero(pressure.any(axis=0))
        far = max(-edges[touched[0]], edges[touched[-1] + 1])
        some = np.abs(edges) <= far * (1 + 1e-9)
        sides.append((edges[some], below[:, some] / below[:, -1:]))
    return sides
