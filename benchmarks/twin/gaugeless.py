"""Twins without a gauge: random skins by `fem`, seen through rendered markers, and their fits."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.paper.study import made
from benchmarks.processes import rows_of
from benchmarks.report import Page, Run, table
from learning.choice.run import Request, run_choice, twin_labels
from learning.data.matching import SensorSelection
from learning.transfer.score import new_frames, score_of
from recorder import MarkerArchive
from recorder.markers import find_blobs, smallest_marker
from sim.cli.labels import add_forces
from sim.dataset import DatasetPlan, Solving
from sim.errors import SimulationDiverged
from sim.fem import Fem
from sim.indenters import NAMES, named
from sim.layer import Layer
from sim.result import ContactTier, Result
from sim.scene import Effects, Friction, Scene
from sim.sensors import CameraSignal, SimulatedSensor, SurfaceField, readout, sensor
from sim.sensors.quantities import camera_quantities, with_camera, with_quantities
from sim.sensors.variation import Grip, Mount, Segmentation
from sim.twin.gaugeless import ABOVE, FEM, LAYER, MarkedPress, fitted_without_gauge, solved_by
from sim.twin.markers import Follower
from sim.twin.model import leaning, motion_of, printed
from sim.twin.record import twin_yaml

Array = NDArray[np.float64]

# Indenters of the fit and of its weight, and unseen ones.
PRESSED, LAID = ("sphere", "sphere_s", "hemisphere"), "hemisphere"
UNSEEN = ("torus", "cylinder_si", "dots")
# Indenters of frames that the twin labels, and some of the unseen ones' presses beside them.
LABELLED = (
    *("sphere", "sphere_s", "hemisphere", "cylinder", "hexagon", "prism", "wave", "pacman"),
    *("triangle", "moon"),
)
FRACTION, STEPS, WAYS, DRAWS = 0.025, 4, ("mean", "ridge", "cells", "kernel"), 2
# Spread of the logarithm of true relaxation about the design's, which a fit without a gauge keeps.
RELAXED = 0.3
# Depths of two presses over the design's thickness, and ways sideways over it.
DEPTHS, SHEAR = (0.15, 0.27), 0.22
# Depths of presses by unseen indenters, and where they end [m].
UNSEEN_DEPTHS, UNSEEN_SHEAR = (3e-4, 6e-4, 9e-4), (5e-4, 2e-4, -9e-4)
# Depths over the thickness to which the weight presses that is laid on a skin.
LAID_DEEP = (0.2, 0.3)
TRUTH = Fem(fineness=1.0, augmentations=1, tolerance=3e-4, step_travel=0.2e-3, elements_max=60_000)
# Errors of segmentation [px]; parts of a press between pictures, over which markers are followed.
SEEN = Segmentation(jitter_px=0.3, correlation_px=4.0, missing=0.002)
FOLLOWED = (0.25, 0.5, 0.75, 1.0)
COMPARED = ("modulus", "thickness", "poisson", "friction")


class Skin:
    """Random skin of a design, its bench and its camera."""

    def __init__(self, seed: int, device: str, quick: bool) -> None:
        self.random = random = np.random.default_rng([62, seed])
        self.device, self.quick = device, quick
        design = replace(sensor("gelsight"), trajectory=None, force_depth=None)
        assert isinstance(design.signal, CameraSignal)
        pattern = ("GelSight", "Array-I")[seed % 2]
        self.design = replace(design, signal=replace(design.signal, patterns=(pattern,)))
        self.true = {
            "modulus": float(np.exp(random.uniform(np.log(50e3), np.log(300e3)))),
            "thickness": random.uniform(2.5e-3, 5.5e-3),
            "poisson": random.uniform(0.40, 0.485),
            "friction": random.uniform(0.25, 0.9),
        }
        self.compliance = random.uniform(0.0, 20e-6)
        camera = camera_quantities(self.design)
        shift = dict(zip(("shift_x", "shift_y"), random.normal(0.0, 6.0, 2).tolist(), strict=True))
        scale = float(np.exp(random.normal(0.0, 0.005)))
        camera |= shift | {"scale": scale * camera["scale"], "rotation": random.normal(0.0, 0.013)}
        wide = replace(self.design, depth_max=0.9 * self.design.body.thickness)
        self.skin = with_camera(with_quantities(wide, self.true), camera)
        self.skin = replace(
            self.skin,
            depth_max=0.9 * self.true["thickness"],
            effects=Effects(friction=Friction(self.true["friction"])),
            variation=replace(self.skin.variation, segmentation=SEEN),
        )

    def solve(self, scenes: Sequence[Scene], tier: Fem | Layer) -> list[Any]:
        """Return the outcomes of scenes, in a quick run by tier `layer`."""
        return solved_by(scenes, LAYER if self.quick else tier, device=self.device)

    def mounted(self, name: str) -> dict[str, Any]:
        """Return the errors of one mounting of an indenter."""
        random, angle = self.random, self.random.normal(0.0, 0.026)
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return {
            "indenter": printed(named(name), random.normal(0.0, 0.1e-3)),
            "place": random.normal(0.0, 0.3e-3, 2),
            "tilt": tuple(random.normal(0.0, 0.0175, 2).tolist()),
            "height": random.normal(0.0, 30e-6),
            "turn": turn,
        }

    def scene(
        self, tip: Array, mounted: dict[str, Any], skin: SimulatedSensor, force: Any = 0.0
    ) -> Scene:
        """Return a press where the bench takes the tip (n, 3) [m] to be, its mount yielding."""
        seen = tip + np.array([*mounted["place"], 0.0])
        seen[:, :2] = seen[:, :2] @ mounted["turn"].T
        indenter, seen = leaning(mounted["indenter"], seen, mounted["tilt"])
        seen[:, 2] -= mounted["height"]
        seen[1:, 2] += self.compliance * np.abs(force)
        way = np.linalg.norm(np.diff(seen, axis=0), axis=1)
        return skin.scene(indenter, motion_of(seen, np.r_[0.0, np.cumsum(way / 5e-3)]))

    def followed(
        self, result: Result, name: str, mounting: int, tip: Array, weight: float
    ) -> MarkedPress:
        """Return the markers of a press in rendered pictures."""
        top = SurfaceField.of(result)
        camera = readout(self.skin, seed=mounting, device=self.device)
        blank = camera.masks(replace(top, displacement=0 * top.displacement[:1]))[0, 0]
        blobs = find_blobs(blank[None], smallest_marker(blank))
        markers = blobs.centre[blobs.whole]
        follower, seen = Follower(markers, float(np.median(blobs.area))), []
        before = top.displacement[:1] * 0
        for rest in range(1, len(tip)):
            after = top.displacement[rest : rest + 1]
            ways = np.concatenate([before + part * (after - before) for part in FOLLOWED])
            for mask in camera.masks(replace(top, displacement=ways), 100 * mounting + 10 * rest)[
                :, 0
            ]:
                at = follower.step(mask)
            seen.append(at)
            before = after
        given = tip, markers, np.array(seen), weight, follower.radius
        return MarkedPress(name, name, mounting, *given)

    def yielded(self, outcome: Any) -> Array:
        """Return the forces (f,) [N] of a press whose mount yields, from those of a rigid one.

        They grow with the depth to the power of 1.6, near enough for that of the mount.
        """
        if not isinstance(outcome, Result):
            return np.zeros(1)
        rigid, depth = np.abs(outcome.force[1:, 2]), -outcome.scene.motion.depth_max
        force = rigid
        for _ in range(30):
            force = (force + rigid * np.maximum(1 + self.compliance * force / depth, 0) ** 1.6) / 2
        return np.asarray(force)

    def presses(self) -> list[MarkedPress]:
        """Return the presses of an arm, and of a weight."""
        due = []
        for number, name in enumerate(PRESSED):
            mounted = self.mounted(name)
            for part in DEPTHS:
                depth, way = part * 4e-3, SHEAR * 4e-3
                angle = self.random.uniform(0.0, 2 * np.pi)
                end = way * np.cos(angle), way * np.sin(angle)
                tip = np.array([[0.0, 0.0, ABOVE], [0.0, 0.0, -depth], [*end, -depth]])
                due.append((name, number, tip, mounted, 0.0))
        upright = self.mounted(LAID) | {"height": 0.0, "place": self.random.uniform(-1e-3, 1e-3, 2)}
        depth = self.random.uniform(*LAID_DEEP) * self.true["thickness"]
        down = np.array([[0.0, 0.0, ABOVE], [0.0, 0.0, -depth]])
        due.append((LAID, len(PRESSED), down, upright, 1.0))
        rigid = [self.scene(tip, mounted, self.skin) for _, _, tip, mounted, _ in due]
        *first, laid = self.solve(rigid, TRUTH)
        if not isinstance(laid, Result):
            raise SimulationDiverged(f"weight: {laid}")
        self.weight = -float(laid.force[-1, 2])
        forces = [self.yielded(each) for each in first]
        again = [
            self.scene(tip, mounted, self.skin, force)
            for (_, _, tip, mounted, _), force in zip(due, forces, strict=False)
        ]
        results = [*self.solve(again, TRUTH), laid]
        return [
            self.followed(result, name, number, tip, weight * self.weight)
            for (name, number, tip, _, weight), result in zip(due, results, strict=True)
            if isinstance(result, Result)
        ]

    def row(self, folder: Path) -> dict[str, Any]:
        """Fit without a gauge, and return errors of quantities and of unseen indenters' forces."""
        begun = time.perf_counter()
        tier: ContactTier = "layer" if self.quick else "fem"
        fit = fitted_without_gauge(self.presses(), self.design, tier=tier, device=self.device)
        seconds = time.perf_counter() - begun
        twin = {name: fit.values[name] for name in COMPARED}
        wide = replace(self.design, depth_max=0.9 * self.design.body.thickness)
        own = replace(
            with_quantities(wide, twin), effects=Effects(friction=Friction(twin["friction"]))
        )
        path = np.array([[0, 0, ABOVE], *([0, 0, -d] for d in UNSEEN_DEPTHS), UNSEEN_SHEAR])
        still = {"place": (0.0, 0.0), "tilt": (0.0, 0.0), "height": 0.0, "turn": np.eye(2)}
        true, ours = (
            [self.scene(path, {**still, "indenter": named(n)}, skin) for n in UNSEEN]
            for skin in (self.skin, own)
        )
        pairs = [
            (one.force[1:], other.force[1:])
            for one, other in zip(self.solve(true, TRUTH), self.solve(ours, FEM), strict=True)
            if isinstance(one, Result) and isinstance(other, Result)
        ]
        force, predicted = (np.concatenate(each) for each in zip(*pairs, strict=True))
        square = np.square(force - force.mean(axis=0)).sum(axis=0)
        intervals = {name: fit.interval(name) for name in COMPARED}
        return {
            "weight": self.weight,
            "true": self.true,
            "values": twin,
            "intervals": intervals,
            "inside": {n: low < self.true[n] < high for n, (low, high) in intervals.items()},
            "noise": fit.noise,
            "rounds": fit.rounds,
            "seconds": seconds,
            "answers": len(pairs),
            "r2": (1 - np.square(force - predicted).sum(axis=0) / square).tolist(),
            "frames": self.from_frames(fit.sensor, folder),
        }

    def from_frames(self, twin: SimulatedSensor, folder: Path) -> dict[str, Any]:
        """Record frames of the skin, label them by its twin, and score the model on unseen ones."""
        folder.mkdir(parents=True)
        mount, grip = Mount(0.3e-3, 0.026, 30e-6), Grip(0.0175)
        design = sensor("gelsight")
        viscosity = design.effects.viscosity
        assert viscosity is not None
        ratios = np.exp(self.random.normal(0.0, RELAXED, 2)) * viscosity.ratios
        viscosity = replace(viscosity, ratios=tuple(map(float, ratios)))
        row = replace(
            self.skin,
            effects=replace(self.skin.effects, viscosity=viscosity),
            trajectory=design.trajectory,
            variation=replace(self.skin.variation, mount=mount, grip=grip),
        )
        names = (*UNSEEN, *LABELLED[: 3 if self.quick else None])
        plan = DatasetPlan(
            "targets",
            (row,),
            tuple(sorted(names, key=NAMES.index)),
            Solving("layer" if self.quick else "fem"),
            steps=STEPS,
            fraction=0.01 if self.quick else FRACTION,
        )
        archive = made(folder / "frames.markers.zarr", plan, self.device)
        file = folder / "twin.yaml"
        file.write_text(twin_yaml(replace(twin, trajectory=row.trajectory), "gelsight.yaml", []))
        how: dict[str, Any] = {"draws": DRAWS, "grid": 32, "device": self.device, "processes": 1}
        add_forces(archive, row.name, str(file), **how)
        selected = SensorSelection(MarkerArchive(archive.path), row.name, row.name)
        one = Request(selected, folder / "model", ways=WAYS, unseen=UNSEEN)
        run_choice(one, twin_labels(one), lambda line: None)
        score = score_of(new_frames(one.out, selected))
        return {
            "r2": list(score.errors.r2),
            "coverage": score.coverage,
            "width": score.width.tolist(),
            "outside": score.outside,
            "frames": score.errors.frames,
        }


def measure(run: Run) -> dict[str, Any]:
    """Fit twins of random skins from rendered pictures, and learn forces from their labels."""
    run.seeds = range(1 if run.quick else run.options.skins)
    tasks = {f"skin {seed}": seed for seed in run.seeds}
    job = partial(_row, run.folder, run.device, run.quick)
    return {"rows": [*rows_of(run, job, tasks).values()]}


def _row(folder: Path, device: str, quick: bool, seed: int) -> dict[str, Any]:
    try:
        return {"number": seed, **Skin(seed, device, quick).row(folder / f"skin-{seed}")}
    except SimulationDiverged as diverged:
        return {"number": seed, "why": str(diverged)}


def section(values: dict[str, Any], page: Page) -> str:
    """Return the section of the page."""
    rows = [row for row in values["rows"] if "r2" in row]
    count, lines = len(rows), []
    for name in COMPARED:
        off = [abs(row["values"][name] - row["true"][name]) for row in rows]
        if name != "poisson":
            off = [each / row["true"][name] for each, row in zip(off, rows, strict=True)]
        inside = sum(row["inside"][name] for row in rows)
        lines.append([name, f"{np.median(off):.3g}", f"{max(off):.3g}", f"{inside} of {count}"])
    r2 = np.array([row["r2"] for row in rows])
    frames = [row["frames"] for row in rows]
    fits = np.array([each["r2"] for each in frames])
    worst = np.sort(fits.mean(axis=1))[:2]
    covered = 100 * np.array([each["coverage"] for each in frames])
    width = np.mean([each["width"][2] for each in frames])
    return f"""## Without a gauge: motion of markers and one weight

{count} of {len(values["rows"])} random skins were fitted, from rendered pictures under spheres.
R2 of forces of {", ".join(UNSEEN)}, which no fit has seen, at known places: mean {r2.mean():.3f},
worst skin {r2.mean(axis=1).min():.3f}, Fx, Fy, Fz {" ".join(map("{:.3f}".format, r2.mean(0)))}.

{table(["quantity", "median error", "largest", "in its 90 % interval"], lines)}

From frames of those indenters, which the twin labels on {len(LABELLED)} others: R2 mean
{fits.mean():.3f}, worst skin {worst[0]:.3f}, worst but one {worst[-1]:.3f}, Fx, Fy, Fz
{" ".join(map("{:.3f}".format, fits.mean(0)))}. 90 % intervals contain {covered.mean():.1f} % of the
forces, {covered.min():.1f} % on the worst skin; that of Fz is +-{width:.2f} N wide in the mean. The
skins relax otherwise than the twin assumes.
"""
