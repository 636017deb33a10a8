"""The one place where the mock bench builds simulated sensors; the simulator is imported late."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from rig.bench.indenter import body_of
from rig.bench.worlds import WorldSpec
from rig.core.errors import ConfigError

if TYPE_CHECKING:
    from sim.ladder import Ahead as Ahead
    from sim.ladder import Ladder as Ladder
    from sim.ladder import LadderPress as LadderPress
    from sim.sensors import SimulatedSensor
    from sim.stream import LiveMarkers, Sampler
    from sim.stream import LiveSensor as LiveSensor

# Distance between the places at which a pad's displacement is read [m].
_PAD_STEP = 0.7e-3


@contextmanager
def _errors() -> Iterator[None]:
    try:
        yield
    except ImportError as error:
        raise ConfigError(
            f"world: {error}; allowed: with the simulator, pip install 'tactile-rig[sim]'"
        ) from None
    except ValueError as error:
        raise ConfigError(f"world: {error}") from None


def row_of(spec: WorldSpec) -> SimulatedSensor:
    """Return the simulated sensor of a World, its camera turned as `lab` says.

    Raises:
        ConfigError: The row is unknown or invalid, or the simulator is not installed.
    """
    with _errors():
        from sim.sensors import CameraSignal, sensor_of

        row = sensor_of(spec.sensor)
        if not spec.lab.camera_turned_deg or not isinstance(row.signal, CameraSignal):
            return row
        turned = row.signal.rotation + math.radians(spec.lab.camera_turned_deg)
        rotation = math.remainder(turned, math.tau)
        return replace(row, signal=replace(row.signal, rotation=rotation))


def dome_of(row: SimulatedSensor, tier: str) -> float | None:
    """Return the radius of the top that tips are measured from [m]; None: flat.

    Without a solver a domed body is pressed as a flat one at the height of its dome, too.
    """
    planned = None if row.trajectory is None else row.trajectory.dome_radius
    return planned if tier == "layer" else planned or row.body.dome_radius


def ladder_of(spec: WorldSpec, indenter: str) -> Ladder:
    """Return the presses of a World's skin by the indenter of that name."""
    row = row_of(spec)
    with _errors():
        from sim.ladder import Ladder

        return Ladder.of(body_of(indenter, row.body.thickness), row)


def ladder_press(
    spec: WorldSpec, indenter: str, friction: float = 1.0, ladder: Ladder | None = None
) -> LadderPress:
    """Return the press of a World of tier `ladder`, under the indenter of that name.

    Its friction is that of the row times `friction`; a `ladder` of both is read unless given.
    """
    ladder, effects = ladder or ladder_of(spec, indenter), row_of(spec).effects
    from sim.ladder import LadderPress

    coefficient = effects.friction.coefficient if effects.friction else 0.0
    return LadderPress(ladder, friction * coefficient, effects.viscosity)


def live_sensor(spec: WorldSpec, indenter: str) -> LiveSensor:
    """Return the sensor of a World of tier `layer`, under the indenter of that name."""
    row = row_of(spec)
    with _errors():
        from sim.stream import LiveSensor

        body = body_of(indenter, row.body.thickness)
        return LiveSensor(row, body, grid=spec.solver.grid)


def note_on(spec: WorldSpec) -> str:
    """Return a note on a twin whose fit was by another tier than the one that presses it here."""
    posterior = row_of(spec).posterior
    if posterior is None or posterior.tier == "layer":
        return ""
    return f"; its skin was fitted by tier {posterior.tier}, and tier layer gives it other forces"


def markers_of(spec: WorldSpec) -> LiveMarkers:
    """Return the markers of a World with a camera."""
    row = row_of(spec)
    with _errors():
        from sim.stream import LiveMarkers

        return LiveMarkers(row)


def sampler_of(spec: WorldSpec, points: np.ndarray) -> tuple[Sampler, tuple[int, int]]:
    """Return a reader of a solver's surface at points (n, 2) [m], and its shape (X, Y)."""
    from sim.layer.spectral import PixelGrid
    from sim.stream import Sampler

    grid = PixelGrid(row_of(spec).body, spec.solver.grid)
    return Sampler(grid, points), grid.shape


def taxels_of(spec: WorldSpec) -> tuple[int, int]:
    """Return rows and columns of a World's taxels; (0, 0) of a World with a camera."""
    signal = row_of(spec).signal
    return getattr(signal, "rows", 0), getattr(signal, "columns", 0)


def pad_of(spec: WorldSpec) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Return a pad's points (n, 2) [m], and a function of their displacement (n, 3) [m].

    The function returns raw counts (taxels, 3).
    """
    from sim.sensors import SurfaceField, TaxelPad, TaxelSignal

    row = row_of(spec)
    if not isinstance(row.signal, TaxelSignal):
        raise ConfigError(f"world.sensor: found {spec.sensor!r}, with a camera; allowed: taxels")
    pad = TaxelPad(row.body, row.signal)
    x, y = (
        np.linspace(-size / 2, size / 2, math.ceil(size / _PAD_STEP))
        for size in (row.body.size_x, row.body.size_y)
    )
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)

    def counts(moved: np.ndarray) -> np.ndarray:
        field = SurfaceField(x, y, moved.reshape(1, len(x), len(y), 3).astype(np.float32))
        return np.asarray(pad.raw(field)[0])

    return points, counts
