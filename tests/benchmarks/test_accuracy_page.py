"""The accuracy page: entries, their comparison with references, stored values and plots."""

import math
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from benchmarks.independent.formulas import hertz
from benchmarks.sim.accuracy import campaign
from benchmarks.sim.accuracy.campaign import CLOSED_FORM, AccuracyCampaign, measure, measure_here
from benchmarks.sim.accuracy.cases import CASES, chosen
from benchmarks.sim.accuracy.chart import Panel, Series, save_chart
from benchmarks.sim.accuracy.closed_form import closed_form
from benchmarks.sim.accuracy.competitors import by_name, competitors
from benchmarks.sim.accuracy.page import COLOURS, write_page
from benchmarks.sim.accuracy.reference import Reference, finer, solve_references
from benchmarks.sim.accuracy.row import MEASURES, Measured, Row, append, begin, read
from benchmarks.sim.spent import spent_by
from sim.errors import SceneError
from sim.layer import Layer
from sim.layer.solver import simulate_layer
from sim.metrics import outcome_of
from sim.scene import press

SPHERE = chosen(("sphere",))[0]


def row(case="sphere", ladder="fem even", label="1 mm", error=0.02, **others):
    errors = dict.fromkeys(MEASURES, error)
    given = {"wall": 1.0, "cpu": 0.9, "memory": 2**28, "elements": 1600, "axes": (0.0, 0.0, error)}
    fineness = 1000.0 if label else 0.0
    return Row(case, ladder, label, fineness, "cpu", mean=errors, worst=errors, **(given | others))


def test_every_named_kind_of_press_is_a_case():
    names = [case.name for case in CASES]
    assert names == ["sphere", "punch", "cone", "tube", "indenters", "loop", "hold"]
    assert len(chosen(("indenters",))[0].scenes) == 18
    for case in CASES:
        assert len({scene.effects.key for scene in case.scenes}) == 1
        assert len({scene.body for scene in case.scenes}) == 1
    with pytest.raises(ValueError, match="sphere, punch"):
        chosen(("ball",))


def test_every_competitor_has_a_colour_and_a_name_of_its_own():
    known = competitors()
    assert len({one.name for one in known}) == len(known)
    assert {one.ladder for one in known} <= set(COLOURS)
    assert by_name("layer").cpu_only
    with pytest.raises(SceneError, match="layer"):
        by_name("nothing")
    for ladder in {one.ladder for one in known}:
        fineness = [one.fineness for one in known if one.ladder == ladder]
        assert fineness == sorted(fineness)


def test_closed_forms_press_and_friction_stays_within_coulomb():
    force = closed_form("sphere", SPHERE.scenes[0])
    assert force[-1, 2] == pytest.approx(-hertz(1.5e-3, 4e-3, 0.145e6, 0.45))
    loop = chosen(("loop",))[0].scenes[0]
    force = closed_form("loop", loop)
    assert (np.abs(force[:, 0]) <= 0.5 * -force[:, 2] + 1e-12).all()
    assert force[:, 0].max() > 0 > force[:, 0].min()
    hold = closed_form("hold", chosen(("hold",))[0].scenes[0])
    assert hold[4, 2] < hold[-1, 2] < 0
    assert closed_form("tube", chosen(("tube",))[0].scenes[0]) is None


def test_a_finer_motion_keeps_its_waypoints():
    motion = press([1e-3], hold=1.0, steps=3, speed=1e-3 / 0.1)
    cut = finer(motion, 4)
    assert len(cut) == 4 * (len(motion) - 1) + 1
    assert cut.tip[::4] == motion.tip
    assert cut.time[::4] == motion.time
    assert finer(motion, 1) == motion


def test_memory_and_time_of_a_computation_are_seen():
    def work():
        return float(np.ones(2**25).sum())

    small = spent_by(lambda: 0, "cpu")[1]
    value, spent = spent_by(work, "cpu")
    assert value == 2**25
    assert spent.memory > small.memory + 2**27
    assert spent.wall > 0
    assert spent.cpu > 0


def test_rows_and_floors_come_back_from_their_file(tmp_path):
    path = tmp_path / "cpu.jsonl"
    begin(path, "a machine", "cpu", "fem")
    kept = row(note="half of it", failed=1)
    append(path, {"case": "sphere", "floor": {"force": 0.001, "outside": math.nan}})
    append(path, kept)
    append(path, replace(kept, label="0.5 mm", mean={}, worst={}, axes=(), wall=math.nan))
    begin(path, "another", "cpu", "fem")
    again = read(path)
    assert again.machine == "a machine"
    assert again.rows[0] == kept
    assert math.isnan(again.rows[1].wall)
    assert again.bounds["sphere"]["force"] == 0.001
    assert math.isnan(again.bounds["sphere"]["outside"])
    (tmp_path / "other.jsonl").write_text("{}\n")
    with pytest.raises(ValueError, match="no measurements"):
        read(tmp_path / "other.jsonl")


@pytest.mark.slow
def test_the_page_names_the_cheapest_within_each_error(tmp_path):
    rows = (
        row(ladder="layer", label="", error=0.05, wall=0.01),
        row(label="1 mm", error=0.02, wall=1.0),
        replace(row(label="0.5 mm", error=0.002, wall=9.0), fineness=2000.0),
        replace(row(ladder=CLOSED_FORM, label="", error=0.5), device="none", wall=0.0, memory=0),
        replace(row(label="1 mm", error=0.02, wall=0.1), device="cuda:0"),
        replace(row(case="hold", ladder="mpm"), mean={}, note="refused: viscosity"),
    )
    bounds = {"sphere": dict.fromkeys(MEASURES, 0.0005)}
    page = tmp_path / "accuracy.md"
    write_page(page, tmp_path / "accuracy", [Measured("one core", "cpu", "fem", bounds, rows)])
    text = page.read_text()
    assert "| sphere R 4 mm | CPU | 0.010, layer | 1.00, fem even 1 mm | 9.00, fem" in text
    assert "| sphere R 4 mm | GPU | 0.10, fem even 1 mm |" in text
    assert "refused: viscosity" in text
    assert max(map(len, text.splitlines())) < 400
    for name in ("accuracy", "accuracy-surface", "accuracy-markers", "accuracy-memory"):
        with Image.open(tmp_path / "images" / f"{name}.png") as picture:
            assert picture.width > 1000
            assert len(picture.getcolors(2**16) or range(300)) > 20


def test_a_chart_has_units_a_legend_and_the_band_of_the_reference(tmp_path):
    timed = Series("fem", "#0072b2", "o", ((1.0, 0.5), (9.0, 0.02), (20.0, 0.0)))
    closed = Series("closed form", "#787f8c", "<", ((0.0, 0.3),))
    panels = (Panel("sphere", (timed, closed), 0.05), Panel("punch", (timed,), 0.001))
    path = tmp_path / "chart.svg"
    save_chart(path, "Error", panels, "error [%]", note="one point per mesh")
    drawn = path.read_text()
    for text in ("sphere", "punch", "fem", "closed form", "error [%]", "below the reference's"):
        assert text in drawn
    assert drawn.count("<!-- time [s] -->") == 2
    save_chart(path, "Error", panels[1:], "error [%]", note="no bound above the axis")
    assert "below the reference's" not in path.read_text()


@pytest.mark.slow
def test_a_measurement_says_what_it_took_and_missed():
    case = replace(SPHERE, scenes=(replace(SPHERE.scenes[0], motion=press([0.4e-3])),))
    true = solve_references(case.scenes, 0.5, "cpu")[0]
    found = measure_here(case, by_name("fem even 1.25 mm"), "cpu", [Reference(true, {})])
    assert 0 < found.mean["force_share"] < 0.5
    assert found.wall > 0
    assert found.elements == 16 * 16 * 3
    layer = measure_here(case, by_name("layer"), "cpu", [Reference(true, {})])
    assert layer.elements == 128**2


def test_what_is_expected_to_take_too_long_is_left_out_and_nothing_is_measured_twice(
    tmp_path, monkeypatch
):
    known = Reference(
        outcome_of(simulate_layer(SPHERE.scenes[0], Layer(grid=32))), {"force": 0.001}
    )
    made = []

    def pretend(case, one, device, truth):
        made.append(one.name)
        return row(case.name, one.ladder, one.label, wall=1.0)

    monkeypatch.setattr(campaign, "references", lambda *_: [known])
    monkeypatch.setattr(campaign, "_measured", pretend)
    steps = tuple(by_name(f"fem even {size} mm") for size in ("1.25", "0.8", "0.5"))
    plan = AccuracyCampaign("cpu", (SPHERE,), steps, 1.0, 5.0, tmp_path)
    lines = []
    for _ in range(2):
        measure(plan, tmp_path / "cpu.jsonl", lines.append)
    assert made == ["fem even 1.25 mm", "fem even 0.8 mm"]
    kept = read(tmp_path / "cpu.jsonl")
    assert [one.name for one in kept.rows] == [CLOSED_FORM, *made]
    assert kept.bounds["sphere"]["force"] == 0.001
    assert "sphere done" in lines[-1]
