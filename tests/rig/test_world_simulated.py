"""The mock bench with physics: its World's wrench, its camera's images, its failures."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.collecting import faults_of, patient_bench
from support.commands import python

from benchmarks.fake_clock import FakeClock
from benchmarks.faults.collection_run import CollectionRun
from recorder import Session
from rig.bench.bench import BenchFile, bench_from, find_bench, with_simulated_world
from rig.bench.worlds import Solver as SolverSettings
from rig.bench.worlds import WorldSpec
from rig.core.config import build
from rig.core.errors import ConfigError
from rig.core.packaged import BENCHES
from rig.core.samples import ARM_TRUTH, WORLD_STATE, press_state, surface_state
from rig.core.shared_memory import SharedLatest
from rig.mock.bench import MockBench
from rig.mock.world import SimulatedWorld, WorldConfig, build_world, load_view
from rig.mock.world.contact import ContactFrame
from rig.mock.world.picture import coverage
from rig.mock.world.press_solver import Shared, Solver
from rig.mock.world.sensors import live_sensor, markers_of, note_on
from rig.mock.world.simulated import (
    PRESS_FILE,
    SURFACE_FILE,
    Between,
    SimulatedSurface,
    extrapolated,
)
from sim.indenters import named
from sim.sensors import Posterior, sensor, sensor_of
from sim.stream import LivePress, Sampler
from sim.twin.record import twin_yaml

MS = 1_000_000
FRAME = (0.1, -0.2, 0.3, 0.0, 0.0, 0.0)
COARSE = WorldSpec(sensor="gelsight", tier="layer", solver=SolverSettings(grid=32))
SOLVED = press_state(6)
PAD = press_state(54)


def solved(**values: Any) -> np.void:
    state = np.zeros(1, PAD)[0]
    state["friction"] = 0.5
    for name, value in values.items():
        state[name] = value
    return state


def pose(tip: tuple[float, float, float]) -> np.ndarray:
    """Return the TCP's pose in the base frame for a tip in the contact frame."""
    return np.array([*(np.array(FRAME[:3]) + tip), 0.0, 0.0, 0.0])


@pytest.mark.parametrize("sensor", ["gelsight", "gelsight-hetero", "tacpalm", "uskin"])
def test_every_sensor_of_the_lab_has_a_simulated_world(sensor: str) -> None:
    path = find_bench(sensor, BENCHES)
    file = BenchFile.read(path)
    bench, content = file.bench, file.content
    assert bench.world is not None
    assert bench.world.tier == "ladder"
    simulated = bench_from(with_simulated_world(content, str(path)), str(path))
    assert simulated.world == replace(bench.world, tier="layer")


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (lambda: build(SolverSettings, {"rate_hz": 0.0}, "w"), "rate_hz"),
        (lambda: build(SolverSettings, {"grid": 8}, "w"), "grid"),
        (lambda: build(WorldSpec, {"sensor": "gelsight", "depth_mm": 8.0}, "w"), "unknown"),
        (lambda: build(WorldSpec, {}, "w"), "missing sensor"),
        (lambda: live_sensor(WorldSpec(sensor="gelsite"), "sphere"), "gelsite"),
        (lambda: live_sensor(COARSE, "fist"), "fist"),
        (lambda: markers_of(WorldSpec(sensor="uskin")), "camera"),
        (lambda: markers_of(WorldSpec(sensor="mine.yaml")), "no such file"),
        (lambda: with_simulated_world({"mock": False, "world": None}, "b.yaml"), "world: missing"),
    ],
)
def test_a_simulated_world_that_cannot_be_is_refused_with_the_key_or_the_name(
    make: Callable[[], object], word: str
) -> None:
    with pytest.raises(ConfigError, match=word):
        make()


def test_a_twin_that_another_tier_fitted_is_named(tmp_path: Path) -> None:
    assert note_on(COARSE) == ""
    told = Posterior.of(["modulus"], np.array([[0.01]]), "fem")
    for posterior, word in ((replace(told, tier="layer"), ""), (told, "fitted by tier fem")):
        row = tmp_path / "mine.yaml"
        twin = replace(sensor("gelsight"), posterior=posterior)
        row.write_text(twin_yaml(twin, "gelsight.yaml", ["a.zarr"]))
        note = note_on(WorldSpec(sensor=str(row)))
        assert word in note
        assert bool(word) == bool(note)


def test_a_world_goes_on_along_the_slope_of_the_last_solution() -> None:
    slope = np.zeros((54, 3))
    slope[0, 0], slope[2, 2], slope[8, 2] = 1000.0, 2000.0, -5e5
    values = np.zeros(54)
    values[2], values[8] = -2.0, 100.0
    rate = np.zeros(54)
    rate[2] = 10.0
    last = solved(
        t_ns=50 * MS, tip=(0, 0, -1e-3), touching=1, values=values, slope=slope, rate=rate
    )
    found = extrapolated(last, 60 * MS, np.array([1e-4, 0.0, -1.1e-3]))
    assert found[0] == pytest.approx(0.1)
    assert found[2] == pytest.approx(-2.0 - 0.2 + 0.1)
    assert found[8] == pytest.approx(150.0)
    np.testing.assert_array_equal(last["values"], values)
    # Before it touches, the force begins at the undeformed surface.
    last = solved(tip=(0, 0, 1e-3), slope=slope)
    assert not extrapolated(last, 0, np.array([0.0, 0.0, 0.5e-3])).any()
    assert extrapolated(last, 0, np.array([0.0, 0.0, -1e-4]))[2] == pytest.approx(-0.2)


def solution_in(folder: Path) -> Between:
    return Between(WorldSpec("uskin", solver=SolverSettings(rate_hz=62.5)), folder)


def test_a_contact_never_pulls_and_drags_no_more_than_friction_allows(tmp_path: Path) -> None:
    slope = np.zeros((54, 3))
    slope[2, 2], slope[0, 0] = 2000.0, 4000.0
    values = np.zeros(54)
    values[2], values[4] = -0.5, 0.01
    solution = solution_in(tmp_path)
    last = solved(t_ns=1, tip=(0, 0, -2e-4), touching=1, values=values, slope=slope)
    solution.take(last, 1, last["tip"])
    assert solution.at(1, np.array([0.0, 0.0, -2e-4]))[2] == -0.5
    # Half a millimetre up is more than the depth of the contact.
    assert not solution.at(1, np.array([0.0, 0.0, 3e-4]))[:6].any()
    assert not solution.at(1, np.array([0.0, 0.0, 1e-4]))[:6].any()
    assert solution.at(1, np.array([1e-3, 0.0, -2e-4]))[0] == pytest.approx(0.25)


def test_a_new_solution_comes_in_without_a_jump(tmp_path: Path) -> None:
    solution, tip = solution_in(tmp_path), np.array([0.0, 0.0, -1e-3])
    values = np.zeros(54)
    for t_ms, force in ((10, -1.0), (26, -1.6)):
        values[2] = force
        last = solved(t_ns=t_ms * MS, tip=tip, touching=1, values=values)
        solution.take(last, (t_ms + 5) * MS, tip)
    found = [solution.at(ms * MS, tip)[2] for ms in (31, 39, 47, 60)]
    np.testing.assert_allclose(found, (-1.0, -1.3, -1.6, -1.6))


def test_a_state_has_the_wrench_about_the_gauge_and_the_taxels(tmp_path: Path) -> None:
    presses = SharedLatest.create(tmp_path / PRESS_FILE, PAD)
    spec = WorldSpec(sensor="uskin", tier="layer", gauge_depth=0.02)
    world = SimulatedWorld(spec, FRAME, tmp_path)
    tip = (1e-3, 2e-3, -1e-3)
    assert not world.step(5 * MS, pose(tip))["wrench"].any()
    values = np.zeros(54)
    values[:6] = (0.3, 0.1, -2.0, 1e-4, 2e-4, 3e-4)
    values[6:9] = (48_000, 16_500, 70_000)
    presses.write(solved(t_ns=6 * MS, tip=tip, touching=1, values=values, shear=(1e-4, 0)))
    state = world.step(6 * MS, pose(tip))
    assert state["t_ns"] == 6 * MS
    assert state["depth"] == pytest.approx(1e-3)
    np.testing.assert_allclose(state["contact"], tip[:2], atol=1e-12)
    np.testing.assert_allclose(state["shear"], (1e-4, 0))
    lever = np.add(tip, (0, 0, 0.02))
    expected = values[3:6] + np.cross(lever, values[:3])
    np.testing.assert_allclose(state["wrench"], [*values[:3], *expected], atol=1e-9)
    file = tmp_path / "world.json"
    more = {"contact_frame": {"position_mm": [0, 0, 0]}, "folder": str(tmp_path)}
    file.write_text(json.dumps({"world": {"sensor": "uskin", "tier": "layer"}, **more}))
    counts = load_view(file, "taxels")(state)
    np.testing.assert_array_equal(counts[0], (48_000, 16_500, 65_535))
    # The contact frame may be turned.
    turned = ContactFrame((0.1, 0.0, 0.0, 0.0, 0.0, np.pi / 2))
    at = turned.tip(np.array([0.1, 0.02, -0.01, 0, 0, 0]))
    np.testing.assert_allclose(at, (0.02, 0.0, -0.01), atol=1e-12)


def test_the_solver_is_started_with_the_world_that_needs_it(tmp_path: Path) -> None:
    path = find_bench("gelsight", BENCHES)
    read = BenchFile.read(path)
    assert "solver" not in MockBench(read, tmp_path).documents()
    simulated = BenchFile.of(with_simulated_world(read.content, str(path)), path)
    documents = MockBench(simulated.with_indenter("prism"), tmp_path).documents()
    assert documents["solver"] == ("solver", documents["world"][1])
    world = build(WorldConfig, documents["world"][1], "world")
    assert (world.indenter, world.folder) == ("prism", tmp_path)
    assert world.contact_frame == read.bench.contact_frame
    assert isinstance(build_world(world), SimulatedWorld)
    assert isinstance(world.surface(np.zeros((1, 2))), SimulatedSurface)
    file = tmp_path / "world.json"
    dreamt = {"sensor": "gelsight", "tier": "dreamt"}
    file.write_text(json.dumps({**documents["world"][1], "world": dreamt}))
    with pytest.raises(ConfigError, match="dreamt"):
        load_view(file)


class Bench:
    """A solver that is given the arm's position turn by turn."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self.arm = SharedLatest.create(folder / "arm", ARM_TRUTH)
        self.live = live_sensor(COARSE, "sphere")
        shared = Shared(folder, self.live)
        self.presses = SharedLatest.attach(folder / PRESS_FILE, SOLVED)
        clock = FakeClock()
        self.solver = Solver(self.live, ContactFrame(FRAME), self.arm, shared, COARSE, clock)
        shape = self.live.press.grid.shape
        self.surfaces = SharedLatest.attach(folder / SURFACE_FILE, surface_state(shape))

    def at(self, t_ms: int, tip: tuple[float, float, float]) -> None:
        self.arm.write((t_ms * MS, pose(tip), np.zeros(6)))


def test_a_turn_solves_for_the_newest_pose_and_passes_over_the_others(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.solver.turn()
    assert bench.presses.count == 0
    for step in range(9):
        bench.at(2 * step, (0.0, 0.0, -1e-4 * step))
    bench.solver.turn()
    bench.solver.turn()
    assert bench.presses.count == bench.surfaces.count == bench.solver.solved == 1
    last = bench.presses.read()
    assert last is not None
    assert last["t_ns"] == 16 * MS
    assert last["touching"] == 1
    assert last["tip"][2] == pytest.approx(-0.8e-3)
    assert last["values"][2] == pytest.approx(bench.live.press.wrench[2])
    surface = bench.surfaces.read()
    assert surface is not None
    np.testing.assert_array_equal(surface["surface"], bench.live.press.field.displacement[0])
    assert not surface["surface_before"].any()


def test_a_solver_that_falls_behind_in_contact_gives_up_with_the_reason(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.at(10, (0.0, 0.0, 1e-3))
    bench.solver.turn()
    # In the air nothing is lost.
    bench.at(900, (0.0, 0.0, -0.2e-3))
    bench.solver.turn()
    bench.at(1000, (0.0, 0.0, -0.4e-3))
    bench.solver.turn()
    bench.at(1151, (0.0, 0.0, -0.6e-3))
    with pytest.raises(TimeoutError, match="151 ms between two solutions in contact; allowed: 150"):
        bench.solver.turn()
    assert "151 ms at most" in str(bench.solver)


def test_its_world_feels_what_the_solver_found_and_more_as_the_arm_goes_on(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    world = SimulatedWorld(COARSE, FRAME, tmp_path)
    for turn in range(1, 9):
        bench.at(16 * turn, (0.0, 0.0, -1e-4 * turn))
        bench.solver.turn()
        world.step((16 * turn + 5) * MS, pose((0.0, 0.0, -1e-4 * turn)))
    # The rest of the last correction has decayed; the relaxation in the meantime is small.
    at, beyond = (
        world.step(ms * MS, pose((0.0, 0.0, z)))["wrench"][2]
        for ms, z in ((150, -0.80e-3), (152, -0.85e-3))
    )
    assert at == pytest.approx(bench.live.press.wrench[2], rel=0.05)
    bench.at(152, (0.0, 0.0, -0.85e-3))
    bench.solver.turn()
    solved = bench.live.press.wrench[2]
    assert solved < at < -0.1
    assert abs(beyond - solved) < 0.3 * abs(solved - at)


def test_a_picture_goes_on_between_deformations_as_the_tip_does(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    view = SimulatedSurface(COARSE, tmp_path, np.zeros((1, 2)))
    for turn, z in enumerate((-0.6e-3, -0.7e-3, -0.8e-3), 1):
        bench.at(16 * turn, (0.0, 0.0, z))
        bench.solver.turn()
    newest = bench.surfaces.read()
    assert newest is not None
    now, before = newest["surface"], newest["surface_before"]
    tip = np.array([0.0, 0.0, -0.85e-3])
    np.testing.assert_allclose(view.surface(tip), now + (now - before) / 2, atol=1e-9)
    tip[2] = -0.8e-3
    np.testing.assert_allclose(view.surface(tip), now, atol=1e-9)
    # Far ahead, it waits for the next solution.
    tip[2] = -2e-3
    np.testing.assert_allclose(view.surface(tip), now + 1.5 * (now - before), atol=1e-9)


@pytest.mark.parametrize("sensor", ["gelsight", "tacpalm"])
def test_the_camera_sees_the_markers_where_the_simulators_renderer_does(
    sensor: str, tmp_path: Path
) -> None:
    from sim.layer.spectral import PixelGrid
    from sim.sensors import SurfaceField, readout
    from sim.sensors import sensor as row_of

    row = row_of(sensor)
    grid = PixelGrid(row.body, 48)
    across, along = np.meshgrid(grid.x, grid.y, indexing="ij")
    width = row.body.thickness
    bell = np.exp(-((across - 1e-3) ** 2 + along**2) / width**2)
    moved = np.stack([0.3 * across, 0.1 * along, np.full_like(bell, -0.25 * width)], -1)
    moved = (moved * bell[..., None]).astype(np.float32)
    markers = markers_of(WorldSpec(sensor=sensor))
    read = Sampler(grid, markers.points)
    found = coverage(markers.outlines(read(moved))) >= 128
    expected = readout(row).masks(SurfaceField(grid.x, grid.y, moved[None]))[0, 0]
    assert (found & expected).sum() / (found | expected).sum() > 0.975
    still = coverage(markers.outlines(read(0 * moved))) >= 128
    assert (still & expected).sum() / (still | expected).sum() < 0.9


def test_a_picture_has_the_colours_that_the_bench_file_names(tmp_path: Path) -> None:
    colours = {"background": [200, 100, 50], "ink": [10, 20, 30]}
    file = tmp_path / "world.json"
    more = {"contact_frame": {"position_mm": [0, 0, 0]}, "folder": str(tmp_path)}
    world = {"sensor": "gelsight", "tier": "layer", **colours}
    file.write_text(json.dumps({"world": world, **more}))
    image = load_view(file)(np.zeros(1, WORLD_STATE)[0])
    assert (image.shape, image.dtype) == ((480, 640, 3), np.uint8)
    inked = (np.abs(image.astype(int) - (10, 20, 30)) <= 1).all(axis=-1)
    assert 0.04 < inked.mean() < 0.12
    middle = image[180:300, 260:380].reshape(-1, 3)
    lit = 1.08 * np.array([200, 100, 50])
    np.testing.assert_allclose(np.median(middle, axis=0), lit, rtol=0.05)


@pytest.mark.slow
def test_a_solver_that_fails_ends_its_process_with_the_reason(tmp_path: Path) -> None:
    settings = {
        "world": {"tier": "layer", "sensor": "gelsight", "solver": {"grid": 32}},
        "contact_frame": {"position_mm": [1e3 * metre for metre in FRAME[:3]]},
        "folder": str(tmp_path),
        "indenter": "sphere",
    }
    arm = SharedLatest.create(tmp_path / "arm.state", ARM_TRUTH)
    arm.write((MS, np.full(6, np.nan), np.zeros(6)))
    run = python("-m", "rig.mock.emulate", "solver", json.dumps(settings), code=3)
    assert "tip: " in run.stderr.splitlines()[-1]
    assert "allowed: 3 finite numbers" in run.stderr.splitlines()[-1]


@pytest.mark.serial
@pytest.mark.slow
@pytest.mark.parametrize("sensor", ["tacpalm", "gelsight", "uskin"])
def test_a_session_on_the_simulated_bench_holds_what_the_simulator_says(
    sensor: str, tmp_path: Path
) -> None:
    more = "trajectory: {points: [1], angle_step_deg: 180.0}\nworld: {solver: {behind_ms: 4000.0}}"
    bench = patient_bench(tmp_path, sensor, more=more)
    run = CollectionRun.collect(
        tmp_path / "s.zarr", "--targets", "2", "--bench", str(bench), "--world", "sim",
        "--indenter", "sphere",
    )  # fmt: skip
    assert run.wait(240) == 0, run.text
    session = Session(run.session)
    assert session.attrs["bench"]["world"]["tier"] == "layer"
    assert faults_of(run.session) == []
    pose, gauge = session.streams["pose"], session.streams["force"]
    frame, wrench = np.asarray(session.attrs["contact_frame"]), np.asarray(gauge.array("value"))
    place = np.asarray(pose.array("value"))[: len(pose.t_ns), :3] - frame[:3]
    tips = Rotation.from_rotvec(frame[3:]).inv().apply(place)
    times, at = (
        1e-9 * (np.asarray(each.t_ns) - np.asarray(pose.t_ns)[0]) for each in (pose, gauge)
    )
    world = sensor_of(str(session.attrs["bench"]["world"]["sensor"]))
    live, offline = LivePress(world, named("sphere"), grid=48), np.zeros((len(times), 3))
    for row, tip in enumerate(tips):
        live.move(tip, times[row] - times[max(row - 1, 0)])
        if live.touching:
            offline[row] = live.force
    inside = (at > 0) & (at < times[-1])
    again = np.stack([np.interp(at[inside], times, axis) for axis in offline.T], axis=1)
    recorded = (wrench[: len(at)] + np.asarray(gauge.attrs["bias"]))[inside, :3]
    error = np.abs(recorded - again)
    # Noise of 0.01 N, and delays of a busy machine; robust to single pauses.
    assert (np.median(error, axis=0) < 0.02).all()
    assert np.percentile(error, 95) < 0.15 * np.abs(offline[:, 2]).max() + 0.03
    assert np.abs(offline[:, 2]).max() > 0.05


def test_the_solver_ends_when_it_is_told_to(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.solver.start()
    bench.solver.close()
    bench.solver.close()
    assert bench.presses.count == 1
    assert bench.solver.failed is None
