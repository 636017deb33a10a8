"""Accuracy benchmark: comparison, choice of times and errors, and failures of a run."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run_module

from benchmarks.accuracy import command, effects, frames, solvers, speed
from benchmarks.accuracy.cases import CASES, finer, solve_reference
from benchmarks.accuracy.competitors import ladders
from benchmarks.accuracy.speed import TimedPress, extrapolated, forces_of
from benchmarks.accuracy.spent import spent_by
from sim import Layer, simulate, simulate_many
from sim.scene import press

BY_NAME = {case.name: case for case in CASES}


def row(label: str, error: float, seconds: float, device: str = "cpu") -> dict[str, Any]:
    return {
        "case": "sphere",
        "ladder": "fem",
        "label": label,
        "fineness": 1 / error,
        "device": device,
        "seconds": seconds,
        "force_share": error,
        "failed": 0,
        "memory": 2**28,
    }


ROWS = [
    row("coarse", 0.05, 0.01),
    row("even", 0.02, 0.8),
    row("fine", 0.002, 9.0),
    row("fine", 0.002, 0.5, "cuda:0"),
    row("through", 0.001, 0.01) | {"failed": 1},
    row("refused", 0.001, 0.01) | {"force_share": None},
]


def test_steps_of_a_ladder_go_from_coarse_to_fine_and_each_ladder_has_a_colour() -> None:
    assert set(ladders()) == set(solvers.COLOURS)
    for steps in ladders().values():
        fineness = [one.fineness for one in steps]
        assert fineness == sorted(fineness)


def test_a_finer_motion_keeps_its_waypoints() -> None:
    motion = press([1e-3], hold=1.0, steps=3, speed=1e-3 / 0.1)
    cut = finer(motion, 4)
    assert len(cut) == 4 * (len(motion) - 1) + 1
    assert cut.tip[::4] == motion.tip
    assert cut.time[::4] == motion.time


def test_memory_and_time_of_a_computation_are_measured() -> None:
    small = spent_by(lambda: 0, "cpu")[1]
    value, spent = spent_by(lambda: float(np.ones(2**25).sum()), "cpu")
    assert value == 2**25
    assert spent.memory > small.memory + 2**27
    assert spent.wall > 0
    assert spent.cpu > 0


def test_the_shortest_time_and_the_error_in_a_second_are_those_of_complete_rows() -> None:
    cpu = solvers.solved(ROWS, "sphere", "CPU")
    assert [each["label"] for each in cpu] == ["coarse", "even", "fine"]
    assert [
        solvers.least(cpu, "seconds", "force_share", goal) for goal in (0.1, 0.03, 0.003, 1e-3)
    ] == [*cpu, None]
    assert solvers.least(cpu, "force_share", "seconds", 1.0) == cpu[1]
    text = solvers.summary({"accuracy": {"rows": ROWS}})
    assert "| sphere R 4 mm | CPU | 0.010 s, fem coarse | 0.80 s, fem even | 9.00 s, fem" in text
    assert "| sphere R 4 mm | GPU | 0.50 s, fem fine |" in text
    assert "In 1 s on one CPU core a force is exact to 2.0 % under the sphere" in text
    assert "In 1 s on a GPU a force is exact to 0.20 %" in text


@pytest.mark.slow
def test_a_row_has_the_error_and_cost_of_its_press_and_slow_steps_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = replace(BY_NAME["sphere"].scene, motion=press([0.4e-3]))
    case = replace(BY_NAME["sphere"], scene=scene)
    true = solve_reference(scene, 0.5, "cpu")
    monkeypatch.setattr(solvers, "SECONDS_MAX", 1e-6)
    (only,) = solvers.climb(case, "fem even", "cpu", true)
    assert 0 < only["force_share"] < 0.5
    assert only["seconds"] > 0
    assert only["elements"] == 16 * 16 * 3


def test_the_papers_presses_are_162_of_which_54_have_a_reference() -> None:
    everything, reference = (
        speed.presses_at(places) for places in (speed.PLACES, speed.REFERENCE_AT)
    )
    assert len(everything) == len(set(everything)) == 18 * 9
    assert len(set(reference) & set(everything)) == len(reference) == 54
    assert {key[:3] for key in speed.read_forces()} <= {
        (one.indenter, one.x, one.y) for one in reference
    }


def test_errors_are_fractions_of_the_reference_where_both_have_a_force_below_the_surface() -> None:
    depths = (0.3, 0.6, 0.9, 1.2)
    reference = {("cone", 0.0, 0.0, depth): np.array([3.0, 0.0, -4.0]) for depth in depths}
    forces = {
        ("cone", 0.0, 0.0, 0.3): np.array([9.0, 9.0, 9.0]),
        ("cone", 0.0, 0.0, 0.6): np.array([3.0, 0.0, -6.5]),
        ("cone", 0.0, 0.0, 0.9): np.array([3.0, 0.5, -4.0]),
        ("wave", 0.0, 0.0, 0.6): np.array([9.0, 9.0, 9.0]),
    }
    errors = speed.errors(forces, reference)
    assert errors["compared"] == 1
    assert (errors["mean"], errors["worst"]) == pytest.approx((0.3, 0.5))
    assert errors["most"] == pytest.approx(0.1 + 0.95 * 0.4)
    assert errors["worst_at"] == "cone at (0, 0) mm, 0.6 mm deep"
    assert speed.errors({}, reference)["mean"] is None


def test_two_meshes_are_extrapolated_and_take_the_time_of_both() -> None:
    sphere, cone = ("sphere", 0.0, 0.0, 0.3), ("cone", 0.0, 0.0, 0.3)
    # An error that falls with the square of the spacing: 1 N without it.
    fine = {sphere: np.array([1.0 + 1.0**2]), cone: np.array([1.0])}
    both = extrapolated(fine, {sphere: np.array([1.0 + 1.5**2])}, 1.5)
    assert both == {sphere: pytest.approx(np.array([1.0]))}
    coarse, finer_ = (
        {"meshes_mm": [size], "seconds": time, "failed": failed, "memory": 1}
        for size, time, failed in ((1.5, 2.0, 3), (1.0, 4.0, 1))
    )
    pair = speed.pair_of(coarse, finer_)
    assert (pair["meshes_mm"], pair["seconds"], pair["failed"]) == ([1.0, 1.5], 6.0, 3)


def test_the_page_has_the_meshes_that_none_on_the_same_device_beats() -> None:
    some = [
        {"device": device, "seconds": time, "mean": error}
        for device, time, error in (
            ("cpu", 4.0, 0.02),
            ("cpu", 2.0, 0.03),
            ("cpu", 3.0, 0.04),
            ("cpu", 1.0, None),
            ("cuda:0", 0.1, 0.05),
        )
    ]
    assert speed.unbeaten(some) == [some[1], some[0], some[4]]


def test_forces_are_kept_to_seven_digits(tmp_path: Path) -> None:
    some = [TimedPress("sphere", -4.0, 0.0, (0.3, 0.6)), TimedPress("sphere", 0.0, 4.0, (0.3,))]
    forces = forces_of(some, simulate_many([one.scene() for one in some], Layer(grid=32)))
    assert [key[1:] for key in forces] == [(-4, 0, 0.3), (-4, 0, 0.6), (0, 4, 0.3)]
    speed.write_forces(forces, tmp_path / "a.csv")
    for key, force in speed.read_forces(tmp_path / "a.csv").items():
        np.testing.assert_allclose(force, forces[key], rtol=1e-6)
    (tmp_path / "a.csv").write_text("run,indenter\n1,sphere\n")
    with pytest.raises(KeyError, match="x_mm"):
        speed.read_forces(tmp_path / "a.csv")


def test_a_cpu_is_forecast_by_its_processes_and_a_gpu_from_as_many_presses_as_fill_it() -> None:
    cpu, one, many = (
        {"device": device, "at_once": count, "seconds": time}
        for device, count, time in (("cpu", 1, 2.0), ("cuda:0", 1, 2.0), ("cuda:0", 64, 4.0))
    )
    assert frames.forecast(cpu, 64, processes=16) == 8.0
    assert frames.forecast(one, 64, processes=1) == 0.0
    assert frames.forecast(many, 256, processes=1) == 16.0
    assert frames.forecast(None, 256, processes=1) == 0.0


def test_tables_of_effects_are_compared_with_full_solves_number_by_number() -> None:
    numbers = {
        **{"force": 0.10, "force_true": 0.13, "force_unsure": 0.02, "force_noise": 0.005},
        **{"marker": 0.5, "marker_true": 0.4, "marker_unsure": 0.08, "marker_noise": 0.03},
        **{"time": 0.2, "time_true": 0.5},
    }
    exact = numbers | {"force_true": 0.1, "marker_true": 0.5, "time_true": 0.2}
    unknown = numbers | dict.fromkeys(("force", "marker", "time"))
    some = [
        {"seconds": 0.5, "effects": [numbers, exact, unknown]},
        {"seconds": 2.0, "effects": [], "reported": "no answer within 120 s"},
    ]
    text = effects.tables(some)
    assert "of 2 random scenes, of which 1 have full solutions" in text
    assert "forces differ by 1.5 % in the median and 3 % at most, 1 of 2 within" in text
    assert "what both state, 1 unknown; markers" in text
    assert "markers differ by 0.05 px in the median and 0.1 px at most, 2 of 2 within" in text
    assert "times by 15 % of the whole in the median" in text
    assert "took 1.25 s in the median, 2.00 s at most" in text


@pytest.mark.slow
def test_kernels_with_an_effects_lines_are_a_trace_in_a_press_that_should_not_have_it() -> None:
    with effects.launched() as plain:
        simulate(effects.scene(), effects.NUMERICS)
    with effects.launched() as heavy:
        simulate(effects.scene("gravity"), effects.NUMERICS)
    off, on = (effects.cost("gravity", base, repeats=1) for base in (plain, heavy))
    assert (off["numbers_off"], off["shared_kernels"], off["numbers_on"]) == (0, 0, 3)
    assert off["kernels_on"] == on["shared_kernels"] == len(effects.KERNELS["gravity"])


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_quick_run_measures_every_part_and_draws_the_page_again(tmp_path: Path) -> None:
    page = tmp_path / "accuracy.md"
    assert run_module(command, "--quick", "--processes", "1", "--out", str(page)) == 0
    stored = json.loads(page.with_suffix(".json").read_text())
    assert list(stored) == [part.name for part in command.BENCHMARK.parts]
    text = page.read_text()
    assert "nan" not in text
    for name in ("solvers", "speed", "frames", "effects", "images"):
        assert (tmp_path / "images" / f"accuracy-{name}.png").stat().st_size > 1000
    assert run_module(command, "--draw", "--out", str(page)) == 0
    assert page.read_text() == text
