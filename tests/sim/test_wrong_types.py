"""Arguments that mean nothing: errors state name, value and allowed values."""

from collections.abc import Callable
from dataclasses import replace
from math import inf, nan
from typing import Any

import numpy as np
import pytest

from sim import (
    Body,
    Effects,
    Friction,
    Gravity,
    Inertia,
    Motion,
    Scene,
    SceneError,
    Viscosity,
    plan,
    press,
    simulate,
    simulate_many,
)
from sim.dataset import DatasetPlan, Solving, gel
from sim.fem import Fem
from sim.fem.mesh import build_mesh
from sim.indenters import Indenter, Part, named, sphere
from sim.indenters.shapes import cone, extruded, flat_punch, from_stl, plane, torus, tube
from sim.layer import Layer
from sim.layer.batch import simulate_layers
from sim.layer.solver import simulate_layer
from sim.layer.spectral import PixelGrid
from sim.markers.camera import Camera
from sim.markers.pattern import Pattern
from sim.markers.renderer import Renderer
from sim.markers.top import cubic_taps
from sim.mpm import Mpm
from sim.mpm.lattice import build_lattice
from sim.mpm.solver import simulate_mpm
from sim.scene import through
from sim.sensors import Pins, SurfaceField, sensor
from sim.sensors.posterior import Posterior
from sim.sensors.taxels import Interior, TaxelPad
from sim.sensors.variation import Drift, Framing, Grip, Mount, Segmentation, SegmentationErrors
from sim.stream import LiveMarkers, LivePress

SCENE = Scene(sphere(4e-3), press([0.5e-3]))
ORIGIN = (0.0, 0.0, 0.0)
PLACES, PLANE = np.linspace(0, 1, 5), np.zeros((1, 2))
DOME = Body(28e-3, 28e-3, 5.5e-3, dome_radius=28.4e-3, footprint="ellipse")
IN_SHEAR = Viscosity((1.0,), (0.1,), "shear")
TAXELS: Any = sensor("uskin").signal
STATES = DatasetPlan("states", (gel(),))


def live() -> LivePress:
    return LivePress(sensor("gelsight"), SCENE.indenter, grid=32, tolerance=2e-3)


def pattern(**wrong: Any) -> Pattern:
    return Pattern(**{"name": "x", "shape": "disc", "size": 1e-3, "places": ((0.0, 0.0),)} | wrong)


def field(**wrong: Any) -> SurfaceField:
    there = {"x": PLACES, "y": PLACES, "displacement": np.zeros((1, 5, 5, 3))}
    return SurfaceField(**there | wrong)


WRONG: dict[str, Callable[[], object]] = {
    "motion.depths[0]: 0 m; allowed: 0 or more, and another than 0.0 m": lambda: press([0]),
    "motion.depths[1]: 0.001 m; allowed: 0 or more, and ano": lambda: press([0.001, 0.001]),
    "motion.depths[0]: None m; allowed": lambda: press([None]),
    "motion.depths: 0.001; allowed: a sequence of numbers [m]": lambda: press(0.001),
    "motion.at: 3; allowed: a sequence of 2 finite": lambda: press([0.001], at=3),
    "motion.at: (0, 'a'); allowed: 2 finite": lambda: press([0.001], at=(0, "a")),
    "motion.speed: '1' m/s; allowed: above 0": lambda: press([0.001], speed="1"),
    "motion.shear: '1' m; allowed": lambda: press([0.001], shear="1"),
    "motion.angle: 90 rad; allowed: -6.28319 to 6.28319 rad": lambda: press([0.001], angle=90),
    "motion.depths[0]: -0.001 m; allowed: 0 or more": lambda: press([-0.001]),
    "motion.steps: 1.5; allowed: whole numbers": lambda: press([0.001], steps=1.5),
    "motion.tip: no positions; allowed": lambda: through([], speed=1),
    "sphere.radius: 4 m; allowed: above 0 to 1 m": lambda: sphere(4),
    "sphere.radius: (0.001, 0.002) m; allowed": lambda: sphere([0.001, 0.002]),
    "torus.ring_radius: 'a' m; allowed": lambda: torus("a", 0.001),
    "cone.half_angle: 45 rad; allowed: 0 to 1.48353 rad": lambda: cone(45),
    "part.values: 'a'; allowed: finite numbers": lambda: extruded("a"),
    "indenter: ['cone']; allowed: sphere": lambda: named(["cone"]),
    "indenter sphere.tilt about x: 90 rad; allowed": lambda: SCENE.indenter.tilted(90, 0),
    "path: 3; allowed: the path of a file": lambda: from_stl(3),
    "layer.grid: 'a'; allowed: a whole number": lambda: Layer("a"),
    "layer.tolerance: 0.5; allowed": lambda: Layer(tolerance=0.5),
    "scenes: Scene(": lambda: simulate_many(SCENE),
    "device: None; allowed: cpu": lambda: simulate(SCENE, device=None),
    "device: 'x'; allowed here": lambda: plan(SCENE, "3 %", device="x"),
    "tolerance: 3; allowed": lambda: plan(SCENE, 3),
    "motion.hold: '1' s; allowed": lambda: press([0.001], hold="1"),
    "motion.tip: 3; allowed: a sequence": lambda: Motion(3, (0.0,)),
    "motion.tip[0]: 1.0; allowed: a sequence of 3": lambda: Motion((1.0,), (0.0,)),
    "motion.tip[0]: (0, 0, '1'); allowed: 3 finite": lambda: Motion(((0, 0, "1"),), (0.0,)),
    "motion.time: 0; allowed: a sequence": lambda: Motion(((0, 0, 0),), 0),
    "motion.time: ('0',)...; allowed": lambda: Motion(((0, 0, 0),), ("0",)),
    "body.thickness: '4e-3' m; allowed": lambda: Body(thickness="4e-3"),
    "effects.friction: 0.5; allowed: a Friction, or None": lambda: Effects(0.5),
    "gravity.acceleration: 9.81; allowed: 3 numbers": lambda: Gravity(9.81),
    "viscosity.ratios: 0.5; allowed: a sequence": lambda: Viscosity(0.5, 1.0),
    "scene.indenter: 'sphere'; allowed: an Indenter": lambda: Scene("sphere", SCENE.motion),
    "scene.motion: 0.001; allowed: a Motion": lambda: Scene(SCENE.indenter, 0.001),
    "scene.body: 4; allowed: a Body": lambda: Scene(SCENE.indenter, SCENE.motion, 4),
    "scene: 'x'; allowed: a Scene": lambda: simulate("x"),
    "scene: 3; allowed: a Scene": lambda: simulate_many([3]),
    "tier: 3; allowed: a Layer, a Fem or an Mpm": lambda: simulate(SCENE, 3),
    "fem.tolerance: '1'; allowed": lambda: Fem(tolerance="1"),
    "fem.halvings: 2.5; allowed: a whole": lambda: Fem(halvings=2.5),
    "fem.one_topology: 'no'; allowed: True or False": lambda: Fem(one_topology="no"),
    "fem.grading: 1; allowed: a Grading": lambda: Fem(grading=1),
    "body.dome_radius: 0.014 m; allowed: 0.0141421 to 1000 m": lambda: Body(dome_radius=14e-3),
    "body.dome_radius: 0.028 m; the lowest place of the rim would": lambda: Body(dome_radius=28e-3),
    "body.footprint: 'round'; allowed: 'rectangle', 'ellipse'": lambda: Body(footprint="round"),
    "body.dome_radius: 0.0284 m; the lowest pla": lambda: replace(DOME, size_x=33e-3, size_y=33e-3),
    "camera.focal: 0.0 px; allowed: 1 to 1e+06 px": lambda: Camera(focal=0.0),
    "camera.distance: nan m; allowed: 0.0001 to 10 m": lambda: Camera(distance=nan),
    "camera.shift[1]: inf px; allowed: -1000 to 1000 px": lambda: Camera(shift=(0.0, inf)),
    "camera.rotation: 4.0 rad; allowed: -3.14159 to 3.14159 rad": lambda: Camera(rotation=4.0),
    "camera.tilt[1]: 0.6 rad; allowed: -0.5 to 0.5 rad": lambda: Camera(tilt=(0.0, 0.6)),
    "camera.mm_per_px: 2.49e-05 mm; allowed: 0.0001 to 10 mm": lambda: Camera.of_scale(0.0249e-3),
    "camera.distance: 0.00311111 m; allowed: abo": lambda: Renderer(Body(), Camera.of_scale(0.005)),
    "render.spacing: 1 m; allowed: 1e-06 to 0.005 m": lambda: Renderer(Body(), spacing=1),
    "patterns: none; allowed: at least one": lambda: Renderer(Body()).textures([]),
    "axis: shape (3,); allowed: at least 4 plac": lambda: cubic_taps(np.array([0.0, 1, 2]), PLACES),
    "axis: does not rise; allowed: rising, f": lambda: cubic_taps(np.array([0.0, 2, 1, 3]), PLACES),
    "axis: does not rise; allowed: rising,": lambda: cubic_taps(np.array([0.0, 1, nan, 3]), PLACES),
    "axis: 0 to 0.1, requested 0 to 1; allowed": lambda: cubic_taps(np.linspace(0, 0.1, 5), PLACES),
    "fem.spacing: 0.0 m; allowed: above 0 to 1 m": lambda: Fem(spacing=0.0),
    "fem.precision: 'half'; allowed: 'auto', 'float32', 'flo": lambda: Fem(precision="half"),
    "fem.tolerance: nan; allowed: 1e-15 to 0.1": lambda: Fem(tolerance=nan),
    "fem.penalty: -1.0; allowed: 1 to 1e+06": lambda: Fem(penalty=-1.0),
    "fem.newton_max: 0; allowed: 1 to 10000": lambda: Fem(newton_max=0),
    "fem.halvings: -1; allowed: 0 to 60": lambda: Fem(halvings=-1),
    "fem.step_travel: 0.0 m; allowed: above 0 to 1 m": lambda: Fem(step_travel=0.0),
    "mesh: elements of 2 mm; allowed: up to 1.333 mm f": lambda: simulate(SCENE, Fem(spacing=2e-3)),
    "mesh: 0.001 mm makes 20000x20000x4000 elements; a": lambda: simulate(SCENE, Fem(spacing=1e-6)),
    "fem.spacing: nan m; allowed: above 0 to 1 m": lambda: simulate(SCENE, Fem(spacing=nan)),
    "device: 'cuda:77'; allowed here: cpu": lambda: simulate(SCENE, device="cuda:77"),
    "processes: 0; allowed: whole numbers from 1 up": lambda: simulate_many([SCENE], processes=0),
    "processes: True; allowed: whole numbers from": lambda: simulate_many([SCENE], processes=True),
    "processes: 2.0; allowed: whole numbers from 1": lambda: simulate_many([SCENE], processes=2.0),
    "device: 'cuda:77'; allowed here: c": lambda: simulate_many([SCENE], Layer(), device="cuda:77"),
    "layer.tolerance: 0.0; al": lambda: simulate_layers(
        [SCENE], Layer(tolerance=0.0), device="cpu"
    ),
    "body.thickness: 0.021 m; allowed": lambda: PixelGrid(Body(size_x=10e-3, thickness=21e-3), 32),
    "grid: 15; allowed: 16 to 512": lambda: PixelGrid(Body(), 15),
    "grid: 513; allowed: 16 to 512": lambda: PixelGrid(Body(), 513),
    "effects.inertia: Inertia(scale=1.0); allowed with tier 'layer': None": lambda: simulate_layer(
        replace(SCENE, effects=Effects(inertia=Inertia()))
    ),
    "effects.gravity: Gravity(": lambda: simulate_layer(
        replace(SCENE, effects=Effects(gravity=Gravity()))
    ),
    "viscosity.relaxes: 'shear'; allowed with tier 'layer': 'all'": lambda: simulate_layer(
        replace(SCENE, effects=Effects(viscosity=IN_SHEAR))
    ),
    "only: 'mpm'; allowed: None, 'layer', 'fem'": lambda: plan(SCENE, "8 %", only="mpm"),
    "device: 'cuda:99'; allowed here: cpu": lambda: plan(SCENE, "8 %", device="cuda:99"),
    "mpm.cell: -0.001 m; allowed: 1e-06 to 1 m": lambda: Mpm(-1e-3),
    "mpm.published: 'taichi'; allowed: 'tacchi', 'genforce', N": lambda: Mpm(published="taichi"),
    "mpm.precision: 'float16'; allowed: 'float32', 'float64'": lambda: Mpm(precision="float16"),
    "mpm.cell: 0.001 m; allowed with published: None": lambda: Mpm(1e-3, published="tacchi"),
    "mpm.cell: 0.008 m with 2 particles per cell g": lambda: build_lattice([SCENE], Mpm(cell=8e-3)),
    "mpm.cell: 1e-05 m with 2 particles per cel": lambda: build_lattice([SCENE], Mpm(cell=0.01e-3)),
    "scenes[1].body.thickness": lambda: simulate_mpm(
        [SCENE, replace(SCENE, body=Body(thickness=5e-3))]
    ),
    "scenes[1].effects: ('fri": lambda: simulate_mpm(
        [SCENE, replace(SCENE, effects=Effects(Friction(0.3)))]
    ),
    "scenes[0].body.footprint: 'ellipse'; ": lambda: simulate(replace(SCENE, body=DOME), Mpm()),
    "scenes[0].body.dome_radi": lambda: simulate(
        replace(SCENE, body=Body(dome_radius=29e-3)), Mpm()
    ),
    "part.values: turns back": lambda: extruded(
        [0.0, 0.0, 0.0, 2e-3, 0.0, 0.0, 1e-3, 0.0, 0.0, 1e-3, 1e-3, 0.0]
    ),
    "indenter sphere.tilt about x: 0.6 rad; allowed: -0.5": lambda: SCENE.indenter.tilted(0.6, 0.0),
    "indenter sphere.tilt: 0.565685424949238 rad; allow": lambda: SCENE.indenter.tilted(0.4, -0.4),
    "indenter sphere.tilt about y: nan rad; allowed: -0.5": lambda: SCENE.indenter.tilted(0.0, nan),
    "indenter sphere.tilt: (0.1,); allowed: angles a": lambda: replace(SCENE.indenter, tilt=(0.1,)),
    "indenter plane.tilt: it has no lowest point when it leans;": lambda: plane().tilted(0.1, 0.0),
    "indenter cone.tilt: it has no lowest point when it": lambda: cone(1.4, 1e-3).tilted(0.3, 0.0),
    "motion: 0 positions and 0 times; allowed: as many of both, at lea": lambda: Motion((), ()),
    "motion: 1 positions and 2 times; allowed: as many of b": lambda: Motion((ORIGIN,), (0.0, 1.0)),
    "motion.tip[1]: (0.0, nan, 0.0); allow": lambda: Motion((ORIGIN, (0.0, nan, 0.0)), (0.0, 1.0)),
    "motion.tip[1]: (0.0, inf, 0.0); allow": lambda: Motion((ORIGIN, (0.0, inf, 0.0)), (0.0, 1.0)),
    "motion.tip[1]: (0.0, 0.0); allowed: 3 finit": lambda: Motion((ORIGIN, (0.0, 0.0)), (0.0, 1.0)),
    "motion.time: (0.5, 1.0)...; allowed: 0 first, t": lambda: Motion((ORIGIN, ORIGIN), (0.5, 1.0)),
    "motion.time: (0.0, 0.0)...; allowed: 0 first, t": lambda: Motion((ORIGIN, ORIGIN), (0.0, 0.0)),
    "motion.time: (0.0, nan)...; allowed: 0 first, t": lambda: Motion((ORIGIN, ORIGIN), (0.0, nan)),
    "motion.time: (0.0, inf)...; allowed: 0 first, t": lambda: Motion((ORIGIN, ORIGIN), (0.0, inf)),
    "motion.speed: 0.0 m/s; allowed: ": lambda: through([ORIGIN, (0.0, 0.0, -1e-3)], speed=0.0),
    "motion.speed: nan m/s; allowed: ": lambda: through([ORIGIN, (0.0, 0.0, -1e-3)], speed=nan),
    "motion.tip[1]: (0.0, 0.0, 0.0), where the tip a": lambda: through([ORIGIN, ORIGIN], speed=1.0),
    "friction.coefficient: -1e-09; allowed: 0 to 10": lambda: Friction(-1e-9),
    "gravity.acceleration: (0.0, 0.0); allowed: 3 numbers": lambda: Gravity((0.0, 0.0)),
    "viscosity: 0 ratios and 0 times; allowed: the same number of both": lambda: Viscosity((), ()),
    "viscosity: 1 ratios and 2 times; allowed: the same num": lambda: Viscosity((1.0,), (1.0, 2.0)),
    "viscosity: 5 ratios and 5 times; allowed: the same": lambda: Viscosity((1.0,) * 5, (1.0,) * 5),
    "viscosity.ratios[0]: -0.1; allowed: 0 to 100": lambda: Viscosity((-0.1,), (1.0,)),
    "viscosity.times[0]: 0.0 s; allowed: 1e-06 to 1e+06 s": lambda: Viscosity((1.0,), (0.0,)),
    "viscosity.relaxes: 'bulk'; allowed: 'all', 'shear'": lambda: Viscosity((1.0,), (1.0,), "bulk"),
    "interior.depth: -0.001 m; allowed: 0 to 0.004 m": lambda: Interior(Body(), -1e-3, PLANE),
    "interior.depth: 0.005 m; allowed: 0 to 0.004 m": lambda: Interior(Body(), 5e-3, PLANE),
    "interior.depth: nan m; allowed: 0 to 0.004 m": lambda: Interior(Body(), nan, PLANE),
    "pins.length: -0.001 m; allowed: 0 to 0.02 m": lambda: Pins(-1e-3, 0.0),
    "pins.base: 1.0 m; allowed: 0 to 0.02 m": lambda: Pins(1e-3, 1.0),
    "motion: 1.4 mm deep into g": lambda: sensor("gelsight").scene(SCENE.indenter, press([1.4e-3])),
    "mount.shift: 0.02 m; allowed: 0 to 0.01 m": lambda: Mount(0.02, 0.0),
    "mount.turn: 2.0 rad; allowed: 0 to 0.2 rad": lambda: Mount(0.0, 2.0),
    "mount.height: 30.0 m; allowed: 0 to 0.001 m": lambda: Mount(0.0, 0.0, 30.0),
    "grip.tilt: 1.0 rad; allowed: 0 to 0.25 rad": lambda: Grip(1.0),
    "framing.shift_px: -1.0 px; allowed: 0 to 100 px": lambda: Framing(-1.0, 0.0),
    "drift.step: nan m; allowed: 0 to 0.001 m": lambda: Drift(nan),
    "segmentation.jitter_px: 2.0 px; allowed: 0 to 1 px": lambda: Segmentation(jitter_px=2.0),
    "segmentation.missing: 1.5; allowed: 0 to 1": lambda: Segmentation(missing=1.5),
    "coverage: bool of shape": lambda: SegmentationErrors(Segmentation(), 0).masks(
        np.zeros((1, 480, 640), bool)
    ),
    "taxels.magnet_depth: 0.004 m; a": lambda: TaxelPad(Body(), replace(TAXELS, magnet_depth=4e-3)),
    "taxels.pitch: 0.0047 m; allowed: up to 0.004 m,": lambda: TaxelPad(Body(size_x=12e-3), TAXELS),
    "body.dome_radius: 0.06 m under taxels; all": lambda: TaxelPad(Body(dome_radius=60e-3), TAXELS),
    "body.footprint: 'ellipse' und": lambda: TaxelPad(replace(Body(), footprint="ellipse"), TAXELS),
    "taxels.pitch: nan m; allowed: 0.0001 to 0.1 m": lambda: replace(TAXELS, pitch=nan),
    "taxels.noise: -1.0; allowed: 0 to 10000": lambda: replace(TAXELS, noise=-1.0),
    "taxels.rest: (0.0, 0.0); allowed: 3 counts": lambda: replace(TAXELS, rest=(0.0, 0.0)),
    "taxels.rest[2]: 70000.0; allowed: 0 to 655": lambda: replace(TAXELS, rest=(0.0, 0.0, 70000.0)),
    "posterior.names: colour; allowed: modulus,": lambda: Posterior(("colour",), (0.1,), ((1.0,),)),
    "posterior: 1 names, 2 spreads, correl": lambda: Posterior(("modulus",), (0.1, 0.2), ((1.0,),)),
    "posterior.spreads.modulus: -0.1; allowed": lambda: Posterior(("modulus",), (-0.1,), ((1.0,),)),
    "posterior.correlations:": lambda: Posterior(
        ("modulus", "thickness"), (0.1, 0.1), ((1.0, 0.5), (0.4, 1.0))
    ),
    "uskin.signal: taxels; al": lambda: LiveMarkers(sensor("uskin")),
    "tip: array([ 0.,  0., nan]); allowed: 3": lambda: live().move(np.array([0.0, 0.0, nan]), 0.02),
    "tip: array([0., 0.]); allowed: 3 finite numbers [m]": lambda: live().move(np.zeros(2), 0.02),
    "duration: -0.02 s; allowed: 0 or more": lambda: live().move(np.zeros(3), -0.02),
    "duration: inf s; allowed: 0 or more": lambda: live().move(np.zeros(3), inf),
    "plan.work: 'dreams'; allowed: 'states', 'targets'": lambda: replace(STATES, work="dreams"),
    "plan.sensors: []; allowed: one or more, all differ": lambda: replace(STATES, sensors=()),
    "plan.sensors: ['gel', 'gel']; allowed: one o": lambda: replace(STATES, sensors=(gel(), gel())),
    "plan.indenters: ['ball']; allowed: sph": lambda: replace(STATES, indenters=("sphere", "ball")),
    "plan.indenters: ('moon', 'sphere'); al": lambda: replace(STATES, indenters=("moon", "sphere")),
    "plan.indenters: ('drawn-1', 'drawn": lambda: replace(STATES, indenters=("drawn-1", "drawn-0")),
    "plan.indenters: ['drawn-01']; allowed: sphe": lambda: replace(STATES, indenters=("drawn-01",)),
    "plan.fraction: 0.0; allowed: above 0 to 1": lambda: replace(STATES, fraction=0.0),
    "plan.steps: 0; allowed: 1 to 1000": lambda: replace(STATES, steps=0),
    "plan.seed: -1; allowed: 0 to 4.29497e+09": lambda: replace(STATES, seed=-1),
    "gel.trajectory: None; allowed: a sensor that has one": lambda: replace(STATES, work="targets"),
    "uskin.signal: taxels; allowed for states": lambda: replace(STATES, sensors=(sensor("uskin"),)),
    "solving.tier: 'mpm'; allowed: 'layer', 'fem'": lambda: Solving(tier="mpm"),
    "solving.spacing: 0.001 m with tier layer; ": lambda: Solving(tier="layer", spacing=1e-3),
    "solving.spacing: 0.001 m with a tolerance; al": lambda: Solving(tolerance="3 %", spacing=1e-3),
    "tolerance: '3 apples'; allowed: a number above 0 with": lambda: Solving(tolerance="3 apples"),
    "solving.spacing: nan m; allowed: above 0 to 1 m": lambda: Solving(spacing=nan),
    "solving.cells: 0; allowed: 1 to 1000": lambda: Solving(cells=0),
    "indenter: 'spoon'; allowed: sphere, sphere_s, hemis": lambda: named("spoon"),
    "indenter cylinder_sh.edge_radius: 0.0005 m; allowed: 0": lambda: named("cylinder_sh", 0.5e-3),
    "indenter line.edge_radius: 0.0011 m; allowed: 0 to 0.001 m": lambda: named("line", 1.1e-3),
    "indenter moon.edge_radius: nan m; allowed: 0 to 0.00125 m": lambda: named("moon", nan),
    "indenter flat_punch.edge_radius: -0.0001 m; allowed: 0 to 0.": lambda: flat_punch(1e-3, -1e-4),
    "indenter cone.edge_radius: 0.0001 m; allowed: 0 to 0 m": lambda: cone(0.3, 0.0, 1e-4),
    "sphere.radius: 0.0 m; allowed: above 0 to 1 m": lambda: sphere(0.0),
    "tube.outer_radius: 0.002 m; allowed: above 0.003 to 1 m": lambda: tube(2e-3, 3e-3),
    "part.view: 'above'; allowed: 'plan', 'side'": lambda: Part("above", "circle", (0.0, 0.0, 1.0)),
    "part.figure: 'star'; allowed: 'half_plane'": lambda: Part("plan", "star", (0.0, 0.0, 1.0)),
    "part.values: 2 for a circle; allowed: 3": lambda: Part("plan", "circle", (0.0, 0.0)),
    "part.values[-1]: -1.0 m; allowed: above 0": lambda: Part("plan", "circle", (0.0, 0.0, -1.0)),
    "part.values: normal (1.0, 1.0); allowed:": lambda: Part("plan", "half_plane", (1.0, 1.0, 0.0)),
    "part.values: (0.0, inf, 1.0); allowed: finit": lambda: Part("plan", "circle", (0.0, inf, 1.0)),
    "part.cosine: 1.0; allowed: -0.99": lambda: Part("plan", "circle", (0.0, 0.0, 1.0), cosine=1.0),
    "indenter none: no parts; allowed: 1 or more": lambda: Indenter("none", ()),
    "indenter odd.parts[0].jo": lambda: Indenter("odd", (Part("plan", "circle", (0.0, 0.0, 1.0)),)),
    "indenter high: the round": lambda: Indenter(
        "high", (Part("turned", "circle", (0.0, 0.0, 1e-3), "union"),)
    ),
    "part.values: 4 for a path; allowed: 3 for each of 2": lambda: extruded([0.0, 0.0, 0.0, 1e-3]),
    "part.values: corner 0 twice; allowed: diffe": lambda: extruded([0.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
    "pattern.shape: 'star'; allowed: 'disc', 'square'": lambda: pattern(shape="star"),
    "pattern.size: 0.5 m; allowed: 1e-05 to 0.1 m": lambda: pattern(size=0.5),
    "pattern.size: nan m; allowed: 1e-05 to 0.1 m": lambda: pattern(size=nan),
    "pattern.places: none; allowed: at least one marker": lambda: pattern(places=()),
    "pattern.places[1]: inf m; allowed: -1 to 1": lambda: pattern(places=((0.0, 0.0), (inf, 0.0))),
    "pattern.places[0]: (0.0,); allowed: (x, y)": lambda: pattern(places=((0.0,),)),
    "pattern.angle: 10.0 rad; allowed: -3.14159 to 3.14159 rad": lambda: pattern(angle=10.0),
    "field.x: shape (5,); allowed: 2 or more ascending num": lambda: field(x=PLACES[::-1]),
    "field.displacement: shape (1, 5, 5, 3); allowed: (frames, x, y,": lambda: field(y=PLACES[1:]),
    "field.displacement: shape (5, 5, 3); allowed": lambda: field(displacement=np.zeros((5, 5, 3))),
    "field.displacement: frame 0 holds NaN": lambda: field(displacement=np.full((2, 5, 5, 3), nan)),
    "mesh: 0.0 m; allowed: above 0": lambda: build_mesh(Body(), 0.0),
    "mesh: nan m; allowed: above 0": lambda: build_mesh(Body(), nan),
    "mesh: -0.001 m; allowed: above 0": lambda: build_mesh(Body(), -1e-3),
    "mesh: 0.005 mm makes 4000x4000x800 elements; allowed: up to": lambda: build_mesh(Body(), 5e-6),
    "scenes[0].effects.viscosity: Viscosity(ratios=(1.0,), times=(0.1,), rel": lambda: simulate_mpm(
        [replace(SCENE, effects=Effects(viscosity=IN_SHEAR))]
    ),
    "scenes[0].effects.inertia: Inertia(scale=1.0); allowed with tier 'mpm'": lambda: simulate_mpm(
        [replace(SCENE, effects=Effects(inertia=Inertia()))]
    ),
    "scenes[0].effects.gravity: Gravity(": lambda: simulate_mpm(
        [replace(SCENE, effects=Effects(gravity=Gravity()))]
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_what_is_wrong_is_named_with_its_value_and_what_is_allowed(message: str) -> None:
    with pytest.raises(SceneError) as told:
        WRONG[message]()
    assert str(told.value).startswith(message)


def test_numbers_and_arrays_of_numpy_are_those_of_python() -> None:
    spread: Any = np.ones(1)
    wide: Any = np.array(20e-3)
    depths: Any = np.array([1e-3])
    of_numpy = Scene(
        sphere(np.float64(4e-3)),
        press(depths, at=(np.float64(0), 0.0), steps=int(np.int64(2))),
        Body(size_x=wide),
        Effects(viscosity=Viscosity(spread / 2, spread)),
    )
    assert of_numpy == Scene(
        sphere(4e-3), press((1e-3,), steps=2), effects=Effects(None, Viscosity((0.5,), (1.0,)))
    )
    single: Any = np.float32(0.004)
    assert repr(sphere(single)) == repr(sphere(float(single)))
    hash(of_numpy)
