"""World without a solver: presses by a ladder of solutions, once per indenter and skin.

    ladder = Ladder.of("prism", sensor("r6"))
    press = LadderPress(ladder, friction=0.5)
    press.move(np.array([0.0, 0.0, -1e-3]), 0.2)
    press.wrench, press.markers(points)

A `Ladder` is a few normal presses by tier `layer`, each deeper than the one before. Everything
else is superposed. In shear a contact of rising pressure p(d) slips from its rim inwards, and its
shear traction is mu (p(d) - p(d*)): that of a deeper press less that of a lighter one (Jaeger,
J. Tribol. 120 (1998) 677; Ciavarella, Int. J. Solids Struct. 35 (1998) 2349). As a sum over the
steps of the ladder it is a set of springs, each with a slider of Coulomb's limit, side by side
(Iwan, J. Appl. Mech. 33 (1966) 893): a press keeps one place per slider, and loading, unloading and
turns follow Masing's rule without a case for each.
"""

import hashlib
import os
import tempfile
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, Self

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from sim.indenters import Indenter, named
from sim.layer.solver import LayerPress
from sim.layer.spectral import PixelGrid
from sim.scene import Body, Effects, Friction, Motion, Scene, Viscosity
from sim.sensors import SimulatedSensor

Array = NDArray[np.floating[Any]]

# Presses of a ladder, and the power of their number with which the depth grows.
STEPS, POWER = 16, 1.3
# Deepest press over the sensor's depth.
BEYOND = 1.15
# Pixels across the body, and residual of the contact.
GRID, TOLERANCE = 128, 2e-3
# Friction of the presses of which a ladder is made.
FRICTION = 0.5
# Pixels per point of the displacement fields along an axis.
COARSE = 2
# Stated error of a force with a table of `fem`, and without one, over the force.
MENDED, UNMENDED = 0.1, 0.25
# Least growth of the tangential stiffness from one step to the next, over the stiffness.
LEAST = 1e-3
# Ladders that come with the simulator.
PACKAGED = Path(__file__).parent / "ladders"


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


class Ladder:
    """Presses of an indenter into a skin at the top's middle, and the fields of its surface."""

    def __init__(self, presses: Presses, body: Body, ratio: Array, deviation: float) -> None:
        """Superpose the presses.

        Args:
            presses: Solutions for a modulus of 1 Pa.
            body: The skin.
            ratio: True force over that of the presses (n,).
            deviation: Stated error of the force, over the force.
        """
        self.body, self.deviation = body, deviation
        self._presses = presses
        self.depths: Array = np.concatenate([[0.0], presses.depth])
        """Depths of the ladder, from 0 (n + 1,) [m]."""
        self.depth_max = float(self.depths[-1])
        """Depth of the deepest step [m]."""
        scale = ratio * body.modulus
        self._forces = np.concatenate([[0.0], -presses.wrench[:, 2] * scale])
        fine = np.linspace(0.0, 1.0, 8 * STEPS + 1) ** POWER * self.depth_max
        self._fine = fine
        self._fine_force = _rising(self.depths, self._forces)(fine)
        self.fields = Fields.of(presses, body)
        sideways = _growing(self.fields.stiffness * scale[:, None])
        self.stiffness: Array = sideways.mean(axis=1)
        """Tangential stiffness of the contact from each step to the next (n,) [N/m]."""
        self.spring: Array = np.diff(self.stiffness, prepend=0.0)
        """Stiffness of each spring (n,) [N/m]."""
        self.sideways: Array = np.diff(sideways, axis=0, prepend=0.0)
        """Stiffness of each spring along x, along y (n, 2) [N/m]."""
        self.start: Array = np.concatenate(
            [[0.0], np.cumsum(np.diff(self._forces)[:-1] / self.stiffness[:-1])]
        )
        """Travel, as of `travel`, from which each spring is pressed (n,) [m]."""

    @classmethod
    def of(cls, indenter: Indenter | str, row: SimulatedSensor, keep: Path | None = None) -> Self:
        """Return the ladder of an indenter, by its name or itself, on a sensor's skin.

        It is read if it comes with the simulator or was kept, otherwise solved, in a few seconds,
        and kept.

        Args:
            indenter: Indenter, or the name of one of the paper's.
            row: Sensor with the skin.
            keep: Folder for ladders that are solved; None: the user's cache.
        """
        shape = named(indenter) if isinstance(indenter, str) else indenter
        still = Motion(tip=((0.0, 0.0, 0.0),), time=(0.0,))
        felt = replace(row.scene(shape, still).indenter, name="")
        presses, ratio, deviation = _presses(felt, row, keep or _cache())
        return cls(presses, row.body, ratio, deviation)

    def normal(self, depth: float) -> float:
        """Return the static force at `depth` [m], in the top's middle [N]."""
        beyond = max(depth - self.depth_max, 0.0)
        last = (self._fine_force[-1] - self._fine_force[-2]) / (self._fine[-1] - self._fine[-2])
        return float(np.interp(depth, self._fine, self._fine_force) + last * beyond)

    def interval(self, depth: float) -> tuple[float, float]:
        """Return the least and the largest force expected at `depth` [m] [N]."""
        force = self.normal(depth)
        return (1 - self.deviation) * force, (1 + self.deviation) * force

    def deepest(self, force: float) -> float:
        """Return the depth at which the static force reaches `force` [N] [m], at most infinity."""
        if force <= 0:
            return 0.0
        most = float(self._fine_force[-1])
        if force >= most:
            last = (most - self._fine_force[-2]) / (self._fine[-1] - self._fine[-2])
            return self.depth_max + (force - most) / float(last)
        return float(np.interp(force, self._fine_force, self._fine))

    def travel(self, force: float) -> float:
        """Return the sideways travel over friction that `force` [N] bears before it slips [m]."""
        at = int(np.clip(np.searchsorted(self._forces, force) - 1, 0, len(self.start) - 1))
        return float(self.start[at] + (force - self._forces[at]) / self.stiffness[at])

    def lateral(self, depth: float) -> tuple[Array, float]:
        """Return the wrench over its normal force (6,) and the height of the contact [m]."""
        unit, height = self._units
        at, part = self.place(depth)
        return (1 - part) * unit[at] + part * unit[at + 1], (1 - part) * height[at] + part * height[
            at + 1
        ]

    def place(self, depth: float) -> tuple[int, float]:
        """Return the step below `depth` [m] and the fraction of the way to the next one."""
        at = int(np.clip(np.searchsorted(self.depths, depth) - 1, 0, len(self.depths) - 2))
        below, above = self.depths[at : at + 2]
        return at, float(np.clip((depth - below) / (above - below), 0.0, 1.0))

    @cached_property
    def _units(self) -> tuple[Array, Array]:
        unit = self._presses.wrench / -self._presses.wrench[:, 2:3]
        height = self._presses.height
        return np.vstack([unit[:1], unit]), np.concatenate([height[:1], height])


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
    """Displacement by a contact of each step that moves by 1 m along x, along y: that of each
    less that of the step before (n, 2, X, Y, 3), float32."""
    stiffness: Array
    """Tangential stiffness of each contact along x, along y, for a modulus of 1 Pa (n, 2) [N/m]."""

    @classmethod
    def of(cls, presses: Presses, body: Body) -> Self:
        """Return the fields of some presses."""
        skin = _skin(body)
        grid = PixelGrid(skin, GRID)
        period, (nx, ny) = grid.period, grid.shape
        symbol = (skin.modulus * grid.symbol).astype(np.float32)
        traction = np.zeros((*presses.traction.shape[:2], *period), np.float32)
        traction[..., :nx, :ny] = presses.traction
        waves = scipy.fft.rfft2(traction)
        added = np.diff(-waves[:, 2], axis=0, prepend=0)
        total = -np.diff(presses.traction[:, 2].sum(axis=(1, 2)), prepend=0)
        weight = np.full(symbol.shape[2], 2.0)
        weight[0] = weight[-1] = 1.0
        power = np.square(np.abs(added)) * weight
        moved = np.stack([(power * one).sum(axis=(1, 2)) for one in symbol[:2]])
        moved = moved / (np.prod(period) * total)
        low = [count // COARSE for count in period]
        reach = [
            min(3 * count // (2 * COARSE), most) for count, most in zip((nx, ny), low, strict=True)
        ]

        def long(spectrum: NDArray[Any]) -> NDArray[Any]:
            half = low[0] // 2
            some = spectrum[..., : low[1] // 2 + 1]
            return np.concatenate([some[..., :half, :], some[..., -half:, :]], axis=-2)

        xx, yy, zz, xy = long(symbol[:4])
        xz, yz = 1j * long(symbol[4:])
        waves, added = long(waves), long(added)

        def back(spectrum: NDArray[Any]) -> Array:
            return np.asarray(scipy.fft.irfft2(spectrum, s=low) / COARSE**2, np.float32)

        def displacement(tx: Any, ty: Any, tz: Any) -> Array:
            parts = (
                xx * tx + xy * ty + xz * tz,
                xy * tx + yy * ty + yz * tz,
                zz * tz - xz * tx - yz * ty,
            )
            whole = np.stack([back(part) for part in parts], axis=-1)
            shift = [(first - n // COARSE) // 2 for first, n in zip(reach, (nx, ny), strict=True)]
            return np.roll(whole, shift, (-3, -2))[..., : reach[0], : reach[1], :]

        # Samples lie at the first pixel of each block.
        axes = [
            (np.arange(count) - count / 2) * COARSE * pixel + pixel / 2
            for count, pixel in zip(reach, grid.pixel, strict=True)
        ]
        normal = displacement(waves[:, 0], waves[:, 1], waves[:, 2])
        normal = np.concatenate([np.zeros_like(normal[:1]), normal])
        sideways = np.stack(
            [
                displacement(added / moved[0][:, None, None], 0, 0),
                displacement(0, added / moved[1][:, None, None], 0),
            ],
            axis=1,
        )
        sideways = np.diff(sideways, axis=0, prepend=np.zeros_like(sideways[:1]))
        stiffness = (total * grid.area / moved).T
        return cls(axes[0], axes[1], normal, sideways, stiffness)

    def at(self, field: Array, points: Array) -> Array:
        """Return a field (X, Y, 3) at points (m, 2) [m], 0 beyond its places (m, 3)."""
        value = np.zeros((len(points), 3), np.float32)
        nodes, parts, inside = [], [], np.ones(len(points), bool)
        for axis, line in zip((self.x, self.y), points.T, strict=True):
            position = (line - axis[0]) / (axis[1] - axis[0])
            inside &= (position >= 0) & (position <= len(axis) - 1)
            node = np.clip(position.astype(int), 0, len(axis) - 2)
            nodes.append(node)
            parts.append((position - node)[:, None].astype(np.float32))
        for i in (0, 1):
            for j in (0, 1):
                weight = np.abs(1 - i - parts[0]) * np.abs(1 - j - parts[1])
                value += weight * field[nodes[0] + i, nodes[1] + j]
        value[~inside] = 0
        return value


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
        count = len(ladder.spring)
        self._elastic: Array = np.zeros((count, 3))
        """Force of each spring at rest: along x and y, and its pressure (n, 3) [N]."""
        self._branches: Array = np.zeros((len(ratios), count, 3))
        """Force of each spring in each branch (b, n, 3) [N]."""
        self._force: Array = np.zeros((count, 3))
        self.tip: Array = np.array([0.0, 0.0, np.inf])
        """Place of the tip in the contact frame (3,) [m]."""

    def move(self, tip: Array, seconds: float) -> None:
        """Move the tip straight to (3,) [m] in `seconds` [s]; 0 is a jump."""
        tip = np.asarray(tip, float)
        aside = tip[:2] - self.tip[:2]
        self.tip = tip
        if tip[2] >= 0 and not self._branches.any() and not self._force.any():
            return
        ladder = self._ladder
        spans = seconds / self._times
        decay = np.exp(-spans)
        gained = self._ratios * np.divide(
            -np.expm1(-spans), spans, out=np.ones_like(spans), where=spans > 0
        )
        factor = 1 + gained.sum()
        held = np.tensordot(decay, self._branches, 1) - gained.sum() * self._elastic
        elastic = self._elastic.copy()
        elastic[:, :2] += ladder.sideways * aside
        travel = ladder.travel(ladder.normal(-tip[2])) if tip[2] < 0 else 0.0
        elastic[:, 2] = ladder.spring * np.maximum(travel - ladder.start, 0.0)
        force = factor * elastic + held
        force[:, 2] = np.maximum(force[:, 2], 0.0)
        limit = self._friction * force[:, 2]
        length = np.hypot(force[:, 0], force[:, 1])
        force[:, :2] *= np.minimum(limit / np.maximum(length, 1e-30), 1.0)[:, None]
        elastic = (force - held) / factor
        change = elastic - self._elastic
        self._branches = decay[:, None, None] * self._branches + gained[:, None, None] * change
        self._elastic, self._force = elastic, force

    @property
    def wrench(self) -> Array:
        """Force and torque of the indenter on the skin, about the tip (6,) [N, N m]."""
        along_x, along_y, pressed = self._force.sum(axis=0)
        unit, height = self._ladder.lateral(self._dent)
        wrench: Array = unit * pressed
        wrench[:2] = along_x, along_y
        wrench[3:5] += -height * along_y, height * along_x
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
        fields = self._ladder.fields
        at, part = self._ladder.place(self._dent)
        field = (1 - part) * fields.normal[at] + part * fields.normal[at + 1]
        moved = self._elastic[:, :2] / self._ladder.sideways
        field += np.tensordot(moved.astype(np.float32), fields.sideways, 2)
        return fields.at(field, np.asarray(points, float) - self.tip[:2] + self.shear)

    @property
    def _dent(self) -> float:
        """Depth of the skin under the tip [m]: deeper than the tip while it recovers."""
        return self._ladder.deepest(float(self._elastic[:, 2].sum()))


# Presses by `layer`, in files.


def _skin(body: Body) -> Body:
    """Return the skin of modulus 1 kPa, square and at least as wide as any contact."""
    if body.dome_radius is not None:
        return replace(body, modulus=1e3)
    side = float(np.clip(5 * body.thickness, 20e-3, 40e-3))
    return Body(side, side, body.thickness, 1e3, body.poisson)


def _cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "tactile-rig" / "ladders"


def _key(felt: Indenter, body: Body) -> str:
    settings = (felt, _skin(body), STEPS, POWER, GRID, TOLERANCE, FRICTION)
    return hashlib.sha256(repr(settings).encode()).hexdigest()[:16]


def _presses(felt: Indenter, row: SimulatedSensor, keep: Path) -> tuple[Presses, Array, float]:
    key = _key(felt, row.body)
    for path in (PACKAGED / f"{key}.npz", keep / f"{key}.npz"):
        presses = _read(path)
        if presses is not None and presses.depth[-1] >= row.depth_max:
            break
    else:
        presses = solved(felt, row.body, BEYOND * row.depth_max)
        _write(path, presses)
    return presses, np.ones(STEPS), UNMENDED


@lru_cache(maxsize=8)
def _read(path: Path) -> Presses | None:
    if not path.is_file():
        return None
    with np.load(path) as file:
        return Presses(**{name: file[name] for name in file.files})


def _write(path: Path, presses: Presses) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".npz", delete=False) as file:
            np.savez_compressed(
                file, **{name: getattr(presses, name) for name in presses.__slots__}
            )
        os.replace(file.name, path)
    except OSError:
        return  # it is solved again the next time


def solved(felt: Indenter, body: Body, deepest: float) -> Presses:
    """Return the presses of an indenter into a skin down to `deepest` [m], by tier `layer`."""
    skin = _skin(body)
    depths = deepest * (np.arange(1, STEPS + 1) / STEPS) ** POWER
    corners = [(0.0, 0.0, 0.0), (0.0, 0.0, -deepest)]
    scene = Scene(felt, Motion(tuple(corners), (0.0, 1.0)), skin, Effects(Friction(FRICTION)))
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


def _growing(stiffness: Array) -> Array:
    """Return the stiffnesses of contacts (n, 2), each at least a little above the one before."""
    least = 1.0 + LEAST * np.arange(len(stiffness))[:, None]
    return np.asarray(np.maximum.accumulate(stiffness / least) * least)


def _rising(x: Array, y: Array) -> Any:
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(x, y)
