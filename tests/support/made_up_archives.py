"""Small synthetic marker archives for tests: patterns moved by an analytic field, matching forces.

A press displaces the image outwards from its position and, while sheared, along the shear:

    d(p) = outward (p - c) / width exp(-|p - c|^2 / (2 width^2)) + shear exp(-|p - c|^2 / (2 far^2))

in pixels, with `outward` = 16 px per mm of depth and `far` = 2 width. Images are the pattern at the
inverse of p + d(p), found by iteration on a coarse grid. All sensors have the same positions and
indenters; their forces differ only by their stiffness.
"""

import functools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from recorder import MarkerArchive
from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan, write_simulated
from recorder.markers import HEIGHT, WIDTH, Lattice, pack
from recorder.spec import PHASES

MM_PER_PX = 0.03
LATTICE = Lattice()
OUTWARD_PX_PER_MM, FAR = 16.0, 2.0
DEPTHS_MM, SHEAR_MM = (1.0, 1.5), 0.6
# Width of the field under an indenter; other indenters use that of the sphere.
WIDTHS_PX = {"sphere": 90.0, "cone": 60.0, "prism": 120.0}
# Force factor of a sensor by its name, which is also that of its pattern.
STIFFNESS = {"dots": 1.0, "grid": 1.6, "diamonds": 0.6, "dense": 1.2}
FORCE_DEPTH_MM = 1.2
NORMAL_N_PER_MM, NORMAL_N_PER_MM2, SHEAR_N_PER_MM = 2.0, 0.8, 1.5


@dataclass(frozen=True, slots=True)
class State:
    """State of the surface under a press at one moment."""

    centre: tuple[float, float]
    """Column and row of the press [px]."""
    width_px: float
    depth_mm: float
    shear_mm: tuple[float, float] = (0.0, 0.0)
    """Components along columns and down rows."""
    loading: bool = True


def made_up_archive(
    path: Path,
    sensors: Sequence[str] = ("dots", "grid"),
    indenters: Sequence[str] = ("sphere", "cone", "prism"),
    unseen: Sequence[str] = ("cone",),
    targets: int = 2,
    frames_per_phase: int = 2,
    displacement: bool = True,
    *,
    force_depth: int = 0,
    unloading: float = 1.0,
    stiffness: Mapping[str, float] = STIFFNESS,
    unlabelled: Sequence[str] = (),
    invalid: Sequence[int] = (),
    finish: bool = True,
) -> MarkerArchive:
    """Make an archive `X.markers.zarr` of sensors of `STIFFNESS`, and open it.

    Each indenter presses `targets` times; a press has one frame without contact and four times
    `frames_per_phase`. No model may be trained on `unseen` indenters. With `displacement` the first
    sensor stores the field and the others share it. `force_depth` presses by the last indenter,
    without a location, end each sensor. `unloading` is a factor on the pressing force while it
    unloads, `stiffness` one on the forces of a sensor. Sensors of `unlabelled` have no wrench;
    `invalid` rows are the same in every sensor. Without `finish`, the last unit is missing.
    """
    presses = _presses(indenters, targets, frames_per_phase, force_depth)
    length = 1 + 4 * frames_per_phase
    plans = tuple(
        SensorPlan(
            name=name,
            rows=length * len(presses),
            chunk_rows=length,
            unit_rows=length * targets,
            references=pack(_pattern(name, *_pixels())[None]),
            mm_per_px=MM_PER_PX,
            lattice=LATTICE if displacement and name == sensors[0] else None,
            displacement_of=sensors[0] if displacement and name != sensors[0] else None,
        )
        for name in sensors
    )
    writer = ArchiveWriter.begin(path, ArchivePlan(plans, tuple(indenters), {"made_up": True}))
    units = writer.sensors[sensors[0]].units
    for unit in range(units - (not finish)):
        rows = writer.sensors[sensors[0]].rows_of(unit)
        within = [(row, *divmod(row, length)) for row in range(rows.start, rows.stop)]
        states = [presses[press][2][frame] for _, press, frame in within]
        table = _table(presses, within, targets)
        table["seen"] = np.array([indenters[each] not in unseen for each in table["indenter"]])
        table["valid"] = np.array([row not in invalid for row, _, _ in within])
        field = np.array([lattice_field(state) for state in states])
        field[~table["valid"]] = np.nan
        masks = np.array([[_packed(name, state) for name in sensors] for state in states])
        masks[~table["valid"]] = 0
        for column, name in enumerate(sensors):
            factor = np.nan if name in unlabelled else stiffness[name]
            wrench = np.array([wrench_of(state, factor, unloading) for state in states])
            wrench[~table["valid"]] = np.nan
            writer.sensors[name].write(
                unit,
                packed=masks[:, column],
                table={**table, "wrench": wrench},
                source=["made up" if there else "missing" for there in table["valid"]],
                displacement=field if displacement and name == sensors[0] else None,
            )
    if finish:
        writer.finish()
    return MarkerArchive(path)


def archive_of(**options: Any) -> Any:
    """Return a fixture: an archive that all tests of a module read."""

    @pytest.fixture(scope="module")
    def archive(tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
        path = tmp_path_factory.mktemp("archive") / "made-up.markers.zarr"
        return made_up_archive(path, **options)

    return archive


def write_twin(archive: MarkerArchive, name: str, force: NDArray[Any], spread: float = 0.1) -> None:
    """Add forces of a twin of one sensor (n, 3) [N], all with the same spread [N]."""
    write_simulated(archive[name], force, np.full(force.shape, spread), f"twin of {name}")


def wrench_of(state: State, stiffness: float, unloading: float = 1.0) -> NDArray[np.float64]:
    """Return Fx Fy Fz [N] and zero torques: quadratic in depth, linear in shear, times width^2."""
    size = (state.width_px / WIDTHS_PX["sphere"]) ** 2
    factor = stiffness * size * (1.0 if state.loading else unloading)
    normal = NORMAL_N_PER_MM * state.depth_mm + NORMAL_N_PER_MM2 * state.depth_mm**2
    right, down = state.shear_mm
    force = (SHEAR_N_PER_MM * right, -SHEAR_N_PER_MM * down, -normal)
    return factor * np.array([*force, 0.0, 0.0, 0.0])


def field_at(state: State, columns: Any, rows: Any) -> tuple[Any, Any]:
    """Return the displacement (column, row) [px] of the material at contact-free positions [px]."""
    x, y = columns - state.centre[0], rows - state.centre[1]
    square = (x**2 + y**2) / (2 * state.width_px**2)
    outward = OUTWARD_PX_PER_MM * state.depth_mm / state.width_px * np.exp(-square)
    along = np.exp(-square / FAR**2) / MM_PER_PX
    return outward * x + along * state.shear_mm[0], outward * y + along * state.shear_mm[1]


def lattice_field(state: State) -> NDArray[np.float16]:
    """Return the field on the lattice, as stored in archives."""
    moved = field_at(state, LATTICE.columns[None, :], LATTICE.rows[:, None])
    return np.stack(moved, axis=-1).astype(np.float16)


def mask_of(name: str, state: State) -> NDArray[np.bool_]:
    """Return the mask (480, 640) of a sensor."""
    return _pattern(name, *_no_contact(state))


# Archives of different tests have most states in common; 2,000 masks take 80 MB.
@functools.lru_cache(2000)
def _packed(name: str, state: State) -> NDArray[np.uint8]:
    """Return the packed mask (38400,) of a sensor."""
    return pack(mask_of(name, state))


# The sensors of an archive share the inverse field.
@functools.lru_cache(4)
def _no_contact(state: State) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the contact-free column and row (480, 640) [px] of the material at each pixel."""
    if state.depth_mm == 0 and state.shear_mm == (0.0, 0.0):
        return _pixels()
    columns, rows = np.meshgrid(_coarse(WIDTH), _coarse(HEIGHT))
    x, y = columns, rows
    for _ in range(12):
        moved = field_at(state, x, y)
        x, y = columns - moved[0], rows - moved[1]
    across, down = _refined(WIDTH), _refined(HEIGHT)
    fine_x, fine_y = (down @ (each.astype(np.float32) @ across.T) for each in (x, y))
    return fine_x, fine_y


def _presses(
    indenters: Sequence[str], targets: int, steps: int, force_depth: int
) -> list[tuple[int, int, list[State]]]:
    """Return code of the indenter, target (those without a location last) and states."""
    made = []
    for code, indenter in enumerate(indenters):
        for target in range(targets):
            path = _sheared(DEPTHS_MM[target % len(DEPTHS_MM)], target, steps)
            made.append((code, target, _states(indenter, code * targets + target, path)))
    for repeat in range(force_depth):
        loading = [(d, 0.0, 0.0, True) for d in np.linspace(0, FORCE_DEPTH_MM, 2 * steps + 1)]
        path = [*loading, *((d, 0.0, 0.0, False) for d, *_ in loading[-2::-1])]
        made.append((len(indenters) - 1, targets + repeat, _states(indenters[-1], 0, path)))
    return made


def _sheared(depth: float, target: int, steps: int) -> list[tuple[float, float, float, bool]]:
    """Return depth, shear right and down [mm], loading: without contact, then four phases."""
    angle = np.pi / 4 * (3 * target + 1)
    right, down = SHEAR_MM * np.cos(angle), SHEAR_MM * np.sin(angle)
    fractions = [step / steps for step in range(1, steps + 1)]
    return [
        (0.0, 0.0, 0.0, True),
        *((depth * fraction, 0.0, 0.0, True) for fraction in fractions),
        *((depth, right * fraction, down * fraction, True) for fraction in fractions),
        *((depth, right * (1 - fraction), down * (1 - fraction), True) for fraction in fractions),
        *((depth * (1 - fraction), 0.0, 0.0, False) for fraction in fractions),
    ]


def _states(
    indenter: str, place: int, path: Iterable[tuple[float, float, float, bool]]
) -> list[State]:
    # Multiples of irrational numbers spread positions evenly for any number of them.
    centre = (
        WIDTH * (0.3 + 0.4 * ((0.5 + 0.755 * place) % 1)),
        HEIGHT * (0.3 + 0.4 * ((0.5 + 0.570 * place) % 1)),
    )
    width = WIDTHS_PX.get(indenter, WIDTHS_PX["sphere"])
    return [State(centre, width, depth, (x, y), loading) for depth, x, y, loading in path]


def _table(
    presses: Sequence[tuple[int, int, list[State]]],
    within: Sequence[tuple[int, int, int]],
    targets: int,
) -> dict[str, NDArray[Any]]:
    """Return the columns that sensors share, for rows of a press and a frame."""
    states = [presses[press][2][frame] for _, press, frame in within]
    code = np.array([presses[press][0] for _, press, _ in within])
    target = np.array([presses[press][1] for _, press, _ in within])
    frame = np.array([frame for *_, frame in within])
    steps = (len(presses[0][2]) - 1) // 4
    phase = np.maximum(frame - 1, 0) // steps
    nowhere = target >= targets
    phase[nowhere] = np.where(frame[nowhere] <= 2 * steps, 0, PHASES.index("normal_dec"))
    centres = np.array([state.centre for state in states])
    offset = (centres - (WIDTH / 2, HEIGHT / 2)) * (1, -1)
    shear = np.array([state.shear_mm for state in states]) * (1, -1)
    return {
        "indenter": code,
        "location": np.where(nowhere, -1, code * targets + target),
        "target": target,
        "phase": phase,
        "depth": np.array([state.depth_mm * 1e-3 for state in states]),
        "position": (offset * MM_PER_PX + shear) * 1e-3,
        "frame": frame,
        "t_ns": frame * 25_000_000,
        "reference": np.zeros(len(frame), np.int64),
    }


@functools.cache
def _pixels() -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    columns, rows = np.meshgrid(np.arange(WIDTH, dtype=np.float32), np.arange(HEIGHT))
    return columns, rows.astype(np.float32)


def _pattern(name: str, x: NDArray[Any], y: NDArray[Any]) -> NDArray[np.bool_]:
    """Return True where there is a marker at positions [px] of the undeformed surface."""
    if name == "diamonds":
        x, y = x + y, y - x
    pitch, half = {"dots": (64, 15), "grid": (72, 14), "diamonds": (88, 18), "dense": (40, 9)}[name]
    # Equivalent to np.mod, in a quarter of its time.
    u, v = (place - pitch * np.floor(place / pitch) - pitch / 2 for place in (x, y))
    if name in ("dots", "dense"):
        return np.asarray(u * u + v * v < half * half)
    return np.asarray((np.abs(u) < half) & (np.abs(v) < half))


def _coarse(side: int) -> NDArray[np.float64]:
    return np.linspace(0, side - 1, side // 10 + 1)


@functools.cache
def _refined(side: int) -> NDArray[np.float32]:
    """Return the matrix (side, n) that interpolates linearly from the coarse grid."""
    coarse = _coarse(side)
    hats = 1 - np.abs(np.arange(side)[:, None] - coarse[None, :]) / (coarse[1] - coarse[0])
    return np.clip(hats, 0, 1).astype(np.float32)
