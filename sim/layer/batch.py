"""Batch of presses of the `layer` tier, solved together on a GPU, each as by `sim.layer.solver`."""

import itertools
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from recorder.processes import cores
from sim.arrays import Array, Progress
from sim.device import check_device
from sim.errors import SimulationDiverged
from sim.layer import Layer
from sim.layer import batch_kernels as kernels
from sim.layer.batch_clearance import BatchClearance
from sim.layer.solver import (
    BULGE,
    HALVINGS,
    TRAVEL,
    TRAVEL_LEAST,
    check_supported,
    diverged_at,
    failed_step,
    precision,
    simulate_layer,
)
from sim.layer.spectral import PixelGrid, convolutions
from sim.result import Outcome, Quality, Result, no_quality
from sim.scalars import PRECISIONS, vector_of
from sim.scene import Scene

Whole = NDArray[np.int64]

# Most presses that are solved at once, and the fraction of the GPU's free memory they may take.
AT_ONCE, MEMORY = 1024, 0.5
# Memory of a pixel, and of each of its frames [B]; twice as much in double precision.
PIXEL, PIXEL_FRAME = 500, 24
# Pixels below an indenter beyond which the single solver takes a press, on a CPU core: work on
# a GPU grows with their square. Chosen by counting operations, not by measuring.
PIXELS_MOST = 6000
# Memory through which frames come to the host [B], and threads that copy them on.
STAGED, COPIERS = 1 << 26, 8
# Threads of a GPU at one press.
LANES = 128
# Overlap of pixels that are not in the list, over the tip's depth, that is tolerated.
OVERLAP = 1e-4
# Times that a list of pixels is extended by those that overlap before a step is refused.
EXTENDED = 20


def simulate_layers(
    scenes: Sequence[Scene],
    layer: Layer = Layer(),
    *,
    device: str,
    progress: Progress | None = None,
) -> list[Outcome]:
    """Simulate many scenes on one device; return a result for each, or the reason for none.

    Scenes are solved together if they have the same body and viscosity, and all of them friction or
    none. Forces are those of `simulate_layer`, which is faster on a CPU, within the tolerance. It
    is left to solve wide contacts on fine pixels, one by one.
    """
    check_device(device)
    for scene in scenes:
        check_supported(scene, layer.tolerance)
    groups: dict[Any, list[int]] = {}
    wide: list[int] = []
    for index, scene in enumerate(scenes):
        if _pixels_below(scene, layer) > PIXELS_MOST:
            wide.append(index)
            continue
        effects = scene.effects
        key = scene.body, effects.viscosity, effects.friction is None
        groups.setdefault(key, []).append(index)
    outcomes: dict[int, Outcome] = {}
    frames = sum(len(scene.motion) for scene in scenes)
    done = 0
    for (body, *_), members in groups.items():
        grid = PixelGrid(body, layer.grid)
        for some in _portions(scenes, members, layer, device):
            batch = LayerBatch([scenes[index] for index in some], grid, layer.tolerance, device)
            for count in batch.advance():
                done += count
                if progress is not None:
                    progress(done / frames)
            outcomes.update(zip(some, batch.outcomes(layer), strict=True))
    for index in wide:
        try:
            outcomes[index] = simulate_layer(scenes[index], layer)
        except SimulationDiverged as diverged:
            outcomes[index] = diverged
        done += len(scenes[index].motion)
        if progress is not None:
            progress(done / frames)
    return [outcomes[index] for index in range(len(scenes))]


def _pixels_below(scene: Scene, layer: Layer) -> float:
    """Return the number of pixels in the box around all that the indenter covers on its way."""
    body, tip = scene.body, np.asarray(scene.motion.tip)
    sides = scene.indenter.bounds_below(scene.motion.depth_max)[:2]
    count = 1.0
    for (low, high), size, way in zip(sides, (body.size_x, body.size_y), tip.T[:2], strict=True):
        ends = np.clip([way.min() + low, way.max() + high], -size / 2, size / 2)
        count *= (ends[1] - ends[0]) * layer.grid / max(body.size_x, body.size_y)
    return count


def _portions(
    scenes: Sequence[Scene], members: list[int], layer: Layer, device: str
) -> list[list[int]]:
    """Return the members in portions that fit into the memory; longer motions take more of it."""
    on = wp.get_device(device)
    memory = MEMORY * on.free_memory if on.is_cuda else math.inf
    double = np.dtype(precision(layer.tolerance)).itemsize / 4
    portions: list[list[int]] = [[]]
    for index in sorted(members, key=lambda one: len(scenes[one].motion)):
        # The last one of a portion has the longest motion, which all have room for.
        apiece = layer.grid**2 * (PIXEL_FRAME * len(scenes[index].motion) + double * PIXEL)
        most = max(1, int(min(memory / apiece, AT_ONCE)))
        if len(portions[-1]) >= most:
            portions.append([])
        portions[-1].append(index)
    return portions


def _host(array: Any) -> NDArray[Any]:
    return np.asarray(array.numpy())


def read_frames(fields: Sequence[Any]) -> list[NDArray[np.float32]]:
    """Return vectors (B, F, P) of a device as arrays (B, F, P, 3).

    A GPU writes pinned memory at its full speed, and several threads copy it on, as most of their
    time goes to new pages: thirty times as fast as one copy to pageable memory (1.5 GB/s).
    """
    each = math.prod(fields[0].shape)
    piece = min(each, STAGED // 12)
    pinned = fields[0].device.is_cuda
    staged = wp.empty(piece, dtype=wp.vec3, device="cpu", pinned=pinned)
    values = _host(staged)
    arrays = []
    with ThreadPoolExecutor(min(COPIERS, cores())) as copiers:
        for field in fields:
            out = np.empty((each, 3), np.float32)
            for first in range(0, each, piece):
                some = out[first : first + piece]
                wp.copy(staged, field.flatten(), src_offset=first, count=len(some))
                wp.synchronize_device(field.device)
                edges = np.linspace(0, len(some), COPIERS + 1).astype(int)
                tasks = [
                    copiers.submit(np.copyto, some[low:high], values[low:high])
                    for low, high in itertools.pairwise(edges)
                ]
                for task in tasks:
                    task.result()
            arrays.append(out.reshape(*field.shape, 3))
    return arrays


class LayerBatch:
    """Layers under indenters, one for each scene, all with the same body on one grid.

    Rows of the arrays on the device are presses, columns the pixels row by row, or the places in
    the list of those that may touch.
    """

    def __init__(
        self, scenes: Sequence[Scene], grid: PixelGrid, tolerance: float, device: str
    ) -> None:
        """Start undeformed, with tips above the first waypoints."""
        began = time.perf_counter()
        self._scenes, self.grid, self._tolerance, self._device = scenes, grid, tolerance, device
        self._precision = np.dtype(precision(tolerance)).name
        real = PRECISIONS[self._precision]
        self._real, self._number = real, np.dtype(self._precision)
        vec3, vec2 = vector_of(real), wp.types.vector(length=2, dtype=real)
        self._vec3 = vec3
        self._lanes = 1 if device == "cpu" else LANES
        friction = scenes[0].effects.friction is not None
        viscosity = scenes[0].effects.viscosity
        self._rubs = friction
        self._ratios = np.array(viscosity.ratios if viscosity else (), float)
        self._times = np.array(viscosity.times if viscosity else (), float)
        count, pixels = len(scenes), math.prod(grid.shape)
        self._clearance = BatchClearance(scenes, grid, real, device)
        kernel = convolutions(grid, np.dtype(self._precision)).kernel
        nx, ny = grid.shape
        friction_of = [one.effects.friction for one in scenes]
        coefficients = [each.coefficient if each else 0.0 for each in friction_of]
        layer = self._layer = kernels.layer_struct(real)()
        layer.ny = ny
        layer.table = self._array(kernel[:, :nx, :ny], real)
        layer.local = vec3(*(min(kernel[0, 0, 0], kernel[1, 0, 0]),) * 2, kernel[2, 0, 0])
        layer.coefficient = self._array(coefficients, real)
        self._contact = kernels.contact_kernel(real, friction, self._lanes)
        (
            self._mark,
            self._tally,
            self._enlist,
            self._recall,
            self._spread,
            self._displace,
            self._take,
            self._measure,
        ) = kernels.state_kernels(real, friction, self._lanes)
        self._keep, self._reach = kernels.frame_kernels(real)

        def zeros(kind: Any, *shape: int) -> Any:
            return wp.zeros(shape, dtype=kind, device=device)

        def by_pixel(kind: Any) -> Any:
            return zeros(kind, count, pixels)

        def fields() -> Any:
            state = kernels.fields_struct(real)()
            state.traction, state.elastic = by_pixel(vec3), by_pixel(vec3)
            state.moved = by_pixel(wp.vec3)
            state.gap, state.extra = by_pixel(real), by_pixel(real)
            return state

        rubbing = (count, pixels) if friction else (1, 1)
        self._branches = zeros(vec3, len(self._ratios), count, pixels)
        self._nothing = zeros(vec3, 0, count, pixels)
        self._still = by_pixel(wp.vec3)
        self._now, self._next = fields(), fields()
        self._touching, layer.listed = by_pixel(wp.int32), by_pixel(wp.int32)
        self._tallied, layer.count = zeros(wp.int32, count, nx), zeros(wp.int32, count)
        self._held, self._guess, self._found = by_pixel(vec3), by_pixel(vec3), by_pixel(vec3)
        scratch = self._scratch = kernels.scratch_struct(real)()
        for name in ("pressure", "gap", "move", "answer"):
            setattr(scratch, name, by_pixel(real))
        for name in ("shear", "slip", "move2", "answer2", "before", "rested"):
            setattr(scratch, name, zeros(vec2, *rubbing))
        scratch.load = by_pixel(vec3)
        self._residual, self._iterations = zeros(real, count), zeros(wp.int32, count)

        lengths = [len(scene.motion) for scene in scenes]
        self._lengths = np.array(lengths)
        frames = max(lengths)
        self._surfaces = zeros(wp.vec3, count, frames, pixels)
        self._tractions = zeros(wp.vec3, count, frames, pixels)
        self._ways = np.zeros((count, frames, 3))
        self._when = np.zeros((count, frames))
        for row, scene in enumerate(scenes):
            self._ways[row, : lengths[row]] = scene.motion.tip
            self._when[row, : lengths[row]] = scene.motion.time
        self.tip = self._ways[:, 0].copy()
        """Positions of the tips (B, 3) [m]."""
        self.tip[:, 2] = np.maximum(self.tip[:, 2], 0.0)
        self._wrench = np.zeros((count, frames, 6))
        self._quality = {
            name: np.full((count, frames), np.nan)
            for name in ("overlap", "contact_width", "residual", "contact", "energy_gap")
        }
        self._quality["slip_excess"] = np.full((count, frames), 0.0 if friction else np.nan)
        self._spent = np.zeros((count, frames, 2), np.int64)
        self._frame = np.zeros(count, np.int64)
        self._failed: dict[int, SimulationDiverged] = {}
        self._tried: dict[int, list[str]] = {}
        # Of steps that failed as a whole, the parts to go, last one first: goal, duration, and how
        # often it was halved.
        self._halves: dict[int, list[tuple[Array, float, int]]] = {}
        self._work, self._most = np.zeros(count), np.zeros(count)
        self._first = np.full((count, 2), np.nan)
        everything = np.arange(count)
        self._clear_at(everything, self.tip, self._now, self._still)
        self._read = self._measured(everything)
        self._last_residual = np.zeros(count)
        self._seconds = {"build": time.perf_counter() - began}

    def _array(self, values: Any, kind: Any) -> Any:
        scalar = {wp.int32: np.int32, wp.vec4i: np.int32, wp.vec3d: np.float64}
        plain = np.ascontiguousarray(values, scalar.get(kind, self._number))
        return wp.array(plain, dtype=kind, device=self._device)

    def _launch(self, kernel: Any, shape: Any, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=shape, inputs=inputs, outputs=outputs, device=self._device)

    def _lane_launch(self, kernel: Any, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(
            kernel,
            dim=(count, self._lanes),
            inputs=inputs,
            outputs=outputs,
            device=self._device,
            block_dim=LANES,
        )

    def _clear_at(self, rows: Whole, tips: Array, fields: Any, top: Any) -> Any:
        """Write the gaps with the tips there; return the least above a displaced `top` (B,) [m]."""
        least = wp.full(
            len(self._scenes), self._real(np.inf), dtype=self._real, device=self._device
        )
        which = self._array(rows, wp.int32)
        tip = self._array(tips, self._vec3)
        self._clearance.at(which, tip, top, fields, least)
        return least

    def _measured(self, rows: Whole, load: Any = None, moved: Any = None) -> Any:
        """Return `READ` of presses (N,); of the load and its displacement, if they are given."""
        out = wp.empty((len(rows), kernels.COLUMNS), dtype=wp.float64, device=self._device)
        which = self._array(rows, wp.int32)
        tip = self._array(self.tip[rows], wp.vec3d)
        samples, fields = self._clearance.samples, self._now
        if load is not None:
            fields = kernels.fields_struct(self._real)()
            fields.traction, fields.elastic, fields.moved = load, load, moved
            fields.gap, fields.extra = self._now.gap, self._now.extra
        coordinates = [samples.x, samples.y, samples.surface]
        inputs = [*coordinates, self._layer, which, tip, fields]
        self._lane_launch(self._measure, len(rows), inputs, [out])
        return _host(out).copy().view(kernels.READ)[:, 0]

    def advance(self) -> Iterator[int]:
        """Move all tips along their motions, yielding the number of frames kept since before."""
        began = time.perf_counter()
        count = len(self._scenes)
        frame, start, left = self._frame, self.tip.copy(), np.ones(count)
        before = np.zeros(count)
        active = np.arange(count)
        while len(active):
            target, now = self._ways[active, frame[active]], self._when[active, frame[active]]
            halving = np.isin(active, list(self._halves))
            fresh = ~halving
            goal, span = target.copy(), np.zeros(len(active))
            goal[fresh], span[fresh] = self._next_goals(
                active[fresh], target[fresh], start[active[fresh]], left
            )
            duration = (now - before[active]) * span
            for index in np.flatnonzero(halving):
                goal[index], duration[index], _ = self._halves[int(active[index])][-1]
            good = self._step(active, goal, duration)
            for row in map(int, active[good & halving]):
                self._halves[row].pop()
                if not self._halves[row]:
                    del self._halves[row]
                    self._tried.pop(row, None)
            for index in np.flatnonzero(~good):
                self._halve(int(active[index]), goal[index], float(duration[index]))
            waits = np.isin(active, list(self._halves) + list(self._failed))
            arrived = active[~waits & (left[active] == 0)]
            if len(arrived):
                self._keep_frames(arrived)
                start[arrived] = self.tip[arrived]
                before[arrived] = self._when[arrived, frame[arrived]]
                left[arrived] = 1.0
                frame[arrived] += 1
            over = np.isin(active, list(self._failed))
            lost = active[over]
            yield len(arrived) + int((self._lengths[lost] - frame[lost]).sum())
            active = active[~over & (frame[active] < self._lengths[active])]
        self._seconds["contact"] = time.perf_counter() - began

    def _halve(self, row: int, goal: Array, duration: float) -> None:
        """Divide a step that failed into two, unless it was halved often enough."""
        steps = self._halves.setdefault(row, [(goal, duration, 0)])
        *_, halved = steps.pop()
        if halved == HALVINGS:
            del self._halves[row]
            self._failed[row] = self._diverged(row)
            return
        middle = (self.tip[row] + goal) / 2
        steps += [(end, duration / 2, halved + 1) for end in (goal, middle)]

    def _next_goals(
        self, rows: Whole, target: Array, start: Array, left: Array
    ) -> tuple[Array, Array]:
        """Return where next steps (N,) end, and their fractions; `left` (B,) becomes the rest."""
        way, rest = target - start, left[rows]
        length = np.linalg.norm(way, axis=1)
        longest = self._longest(rows, target)
        with np.errstate(divide="ignore", invalid="ignore"):
            part = np.where(length > 0, np.minimum(rest, longest / length), rest)
            part = np.where(rest > 0, rest / np.ceil(rest / part - 1e-9), 0.0)
        left[rows] = np.where(part < rest, rest - part, 0.0)
        goal: Array = target - way * left[rows][:, None]
        return goal, part

    def _longest(self, rows: Whole, target: Array) -> Array:
        """Return the longest next steps on the way to targets (N, 3) [m], as `LayerPress`."""
        read = self._read[rows]
        radius = np.sqrt(read["touched"] * self.grid.area / math.pi)
        longest = np.maximum(TRAVEL * radius, TRAVEL_LEAST * min(self.grid.pixel))
        free = np.flatnonzero(radius == 0)
        if len(free):
            least = self._clear_at(rows[free], target[free], self._next, self._now.moved)
            there = _host(least)[rows[free]]
            here = np.maximum(0.0, read["least"][free])
            with np.errstate(divide="ignore", invalid="ignore"):
                part = np.where(there >= 0, 1.0, here / (here - there))
            far = np.linalg.norm(target[free] - self.tip[rows[free]], axis=1)
            longest[free] = np.maximum(longest[free], part * far)
        return np.asarray(longest)

    def _step(self, rows: Whole, tips: Array, durations: Array) -> NDArray[np.bool_]:
        """Attempt a step of presses (N,); return which converged. The others are unchanged."""
        ahead = self._next
        count, pixels = len(rows), self._still.shape[1]
        with np.errstate(divide="ignore", invalid="ignore"):
            spans = durations[:, None] / self._times
            mean_decay = np.where(spans > 0, -np.expm1(-spans) / spans, 1.0)
        decay, gained = np.exp(-spans), self._ratios * mean_decay
        factor = 1 + gained.sum(axis=1)
        least = self._clear_at(rows, tips, ahead, self._still)
        step = self._rates(rows, factor, decay, gained)
        travel = self._array(tips - self.tip[rows], self._vec3)
        allowed = OVERLAP * np.abs(tips[:, 2])
        inputs = [BULGE, step, ahead, self._now, least]
        self._launch(self._mark, (count, pixels), inputs, [self._touching])
        good = np.zeros(count, bool)
        residual, iterations = np.zeros(count), np.zeros(count, np.int64)
        pending = np.arange(count)
        for _ in range(EXTENDED):
            some = rows[pending]
            if len(pending) < count:
                step = self._rates(some, factor[pending], decay[pending], gained[pending])
                travel = self._array(tips[pending] - self.tip[some], self._vec3)
            missed = self._solve(step, len(pending), travel, allowed[pending])
            residual[pending] = _host(self._residual)[some]
            iterations[pending] += _host(self._iterations)[some]
            converged = residual[pending] <= self._tolerance
            good[pending] = converged & ~missed
            pending = pending[converged & missed]
            if not len(pending):
                break
        accepted = rows[good]
        if len(accepted):
            before = self._read["force"][accepted] * self.grid.area
            step = self._rates(accepted, factor[good], decay[good], gained[good])
            shape = len(accepted), pixels
            self._launch(self._take, shape, [step, ahead], [self._branches, self._now])
            shift = tips[good] - self.tip[accepted]
            self.tip[accepted] = tips[good]
            self._read[accepted] = self._measured(accepted)
            force = self._read["force"][accepted] * self.grid.area
            self._work[accepted] += 0.5 * np.einsum("bi,bi->b", before + force, shift)
            self._last_residual[accepted] = residual[good]
        self._spent[rows, self._frame[rows], 0] += iterations
        self._spent[rows, self._frame[rows], 1] += 1
        for index in np.flatnonzero(~good):
            far = float(np.linalg.norm(tips[index] - self.tip[rows[index]]))
            self._tried.setdefault(int(rows[index]), []).append(
                failed_step(far, iterations[index], residual[index], self._tolerance)
            )
        return good

    def _rates(self, rows: Whole, factor: Array, decay: Array, gained: Array) -> Any:
        """Return the struct of a step: presses, and how their layers relax in it."""
        step = kernels.step_struct(self._real)()
        step.which = self._array(rows, wp.int32)
        for name, values in (("factor", factor), ("decay", decay), ("gained", gained)):
            setattr(step, name, self._array(values, self._real))
        return step

    def _solve(self, step: Any, count: int, travel: Any, allowed: Array) -> NDArray[np.bool_]:
        """Solve presses on the pixels that may touch; return whether others overlap, too (N,)."""
        layer, ahead = self._layer, self._next
        by_row, by_pixel = (count, self.grid.shape[0]), (count, self._still.shape[1])
        inputs = [step, self._touching]
        self._launch(self._tally, by_row, [layer, *inputs], [self._tallied])
        self._launch(self._enlist, by_row, [layer, *inputs, self._tallied], [])
        inputs = [layer, step, self._now.elastic, self._branches]
        self._launch(self._recall, by_pixel, inputs, [self._held, self._guess, ahead])
        inputs = [layer, self._tolerance, step, ahead, travel, self._held, self._guess]
        self._lane_launch(
            self._contact,
            count,
            [*inputs, self._scratch],
            [self._found, self._residual, self._iterations],
        )
        inputs = [layer, step, self._held, self._found]
        self._launch(self._spread, by_pixel, inputs, [ahead, self._scratch.load])
        return self._displaced(step, count, allowed)

    def _displaced(self, step: Any, count: int, allowed: Array) -> NDArray[np.bool_]:
        """Write the displacement by the listed loads; return whether other pixels overlap (N,)."""
        missed = wp.zeros(count, dtype=wp.int32, device=self._device)
        room = self._array(allowed, self._real)
        self._launch(
            self._displace,
            (count, self._still.shape[1]),
            [self._layer, step, self._scratch.load, room],
            [self._next, self._touching, missed],
        )
        return np.asarray(_host(missed) > 0)

    def _keep_frames(self, rows: Whole) -> None:
        """Keep the states of presses (N,) as their next frames."""
        frame = self._frame[rows]
        which = self._array(rows, wp.int32)
        self._launch(
            self._keep,
            (len(rows), self._still.shape[1]),
            [which, self._array(frame, wp.int32), self._now],
            [self._surfaces, self._tractions],
        )
        read, area = self._read[rows], self.grid.area
        at = rows, frame
        self._wrench[at] = area * np.concatenate([read["force"], read["torque"]], axis=1)
        quality = self._quality
        overlap = np.maximum(0.0, -read["least"])
        quality["overlap"][at], quality["residual"][at] = overlap, self._last_residual[rows]
        deep = np.maximum(-self.tip[rows, 2], 0.0)
        quality["contact"][at] = np.divide(overlap, deep, out=np.zeros(len(rows)), where=deep > 0)
        quality["contact_width"][at] = self._widths(rows, which, read)
        quality["energy_gap"][at] = self._lost(rows, read)
        if self._rubs:
            pressed = read["pressure"] > 0
            quality["slip_excess"][at] = np.divide(
                np.maximum(read["excess"], 0.0),
                read["pressure"],
                out=np.zeros(len(rows)),
                where=pressed,
            )

    def _widths(self, rows: Whole, which: Any, read: Any) -> Array:
        """Return the widths of the contacts of presses (N,) [m], as `sim.result.width_of`."""
        touches = read["touched"] > 0
        if not touches.any():
            return np.zeros(len(rows))
        boxes = np.where(touches[:, None], read["box"] * [-1, 1, -1, 1], [0, -1, 0, -1])
        width = wp.zeros(len(rows), dtype=wp.float32, device=self._device)
        widest = [
            kernels.FINER * int((boxes[:, k + 1] - boxes[:, k]).max() + 1) + 1 for k in (0, 2)
        ]
        self._launch(
            self._reach,
            (len(rows), *widest),
            [
                self.grid.shape[1], *self.grid.pixel, which,
                self._array(boxes, wp.vec4i), self._now.traction,
            ],
            [width],
        )  # fmt: skip
        return _host(width).astype(np.float64)

    def _lost(self, rows: Whole, read: Any) -> Array:
        """Return the energy that is gone, over the most work done so far, of presses (N,)."""
        energy = read["energy"].copy()
        count, pixels = len(rows), self._still.shape[1]
        ones = self._rates(rows, np.ones(count), np.zeros((count, 0)), np.zeros((count, 0)))
        ahead = self._next
        for index in np.flatnonzero(self._ratios > 0):
            branch = self._branches[int(index)]
            self._launch(
                self._recall,
                (count, pixels),
                [self._layer, ones, branch, self._nothing],
                [self._held, self._scratch.load, ahead],
            )
            self._displaced(ones, count, np.full(count, np.inf))
            energy += self._measured(rows, branch, ahead.moved)["energy"] / self._ratios[index]
        energy *= 0.5 * self.grid.area
        new = np.isnan(self._first[rows, 0])
        self._first[rows[new]] = np.stack([energy[new], self._work[rows[new]]], axis=1)
        stored, done = energy - self._first[rows, 0], self._work[rows] - self._first[rows, 1]
        self._most[rows] = np.maximum(self._most[rows], done)
        most = self._most[rows]
        return np.asarray(np.divide(done - stored, most, out=np.zeros(count), where=most > 0))

    def _diverged(self, row: int) -> SimulationDiverged:
        traction, moved = (
            np.moveaxis(_host(field[row]).reshape(*self.grid.shape, 3), -1, 0)
            for field in (self._now.traction, self._now.moved)
        )
        return diverged_at(self._scenes[row], self.tip[row], traction, moved, self._tried[row])

    def outcomes(self, layer: Layer) -> list[Outcome]:
        """Return the results of all presses, or the reasons for none."""
        nx, ny = self.grid.shape
        began = time.perf_counter()
        surfaces, tractions = (
            field.reshape(*field.shape[:2], nx, ny, 3)
            for field in read_frames([self._surfaces, self._tractions])
        )
        self._seconds["read"] = time.perf_counter() - began
        record = {
            "tier": "layer",
            "mesh": {"grid": [nx, ny], "period": list(self.grid.period)},
            "precision": self._precision,
            "device": self._device,
            "tolerance": layer.tolerance,
            "at_once": len(self._scenes),
            "seconds": {name: round(value, 4) for name, value in self._seconds.items()},
        }
        outcomes: list[Outcome] = []
        for row, scene in enumerate(self._scenes):
            if row in self._failed:
                outcomes.append(self._failed[row])
                continue
            frames = slice(self._lengths[row])
            quality = no_quality(len(scene.motion))
            for name, values in self._quality.items():
                quality[name] = values[row, frames]
            quality["newton"], quality["steps"] = self._spent[row, frames].T
            outcomes.append(
                Result(
                    scene=scene,
                    tier="layer",
                    wrench=self._wrench[row, frames],
                    surface_x=self.grid.x.astype(np.float64),
                    surface_y=self.grid.y.astype(np.float64),
                    surface=surfaces[row, frames],
                    traction=tractions[row, frames],
                    quality=Quality(**quality),
                    record={**record, "effects": list(scene.effects.key)},
                )
            )
        return outcomes
