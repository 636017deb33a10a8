"""The planner: what is asked for, what is looked at, what is chosen, refused and promised."""

import importlib
import math
from dataclasses import replace

import numpy as np
import pytest
from support.made_up_costs import MESHES, made_up, timed_presses

from benchmarks.sim.cost_table.measure import Campaign, conditions_text, measure
from benchmarks.sim.cost_table.scenes import BATCH, HELD_OUT, TRAINING, batch
from benchmarks.sim.cost_table.seconds import write as write_seconds
from benchmarks.sim.cost_table.validation import each_bar, share_covered, share_kept, validate
from benchmarks.sim.reference_solutions import layer_sphere
from sim.effects import Effects, Friction, Gravity, Inertia, Viscosity
from sim.errors import SceneError, SimulationDiverged
from sim.fem.numerics import Numerics
from sim.indenters import flat_punch, sphere
from sim.planner.error_model import HELD_OUT as STORED_HELD_OUT
from sim.planner.error_model import PROMISED, Table, fit, merged, quantile, read, write
from sim.planner.error_model import TRAINING as STORED_TRAINING
from sim.planner.features import (
    COARSER_BY,
    KINDS,
    LADDER,
    NAMES,
    Choice,
    all_choices,
    companion,
    probe,
    tolerance_of,
)
from sim.planner.plan import Planner, plan, simulate_within, with_error_bar
from sim.planner.seconds import fit_seconds
from sim.planner.seconds import read as read_seconds
from sim.scene import Body, Scene, press, press_shear_return, through
from sim.simulate import simulate

SCENE = Scene(sphere(4e-3), press([0.5e-3, 1e-3]))


@pytest.fixture(scope="module")
def planner():
    table = made_up(1, 150)
    return Planner(fit(table), fit_seconds(table, timed_presses()), conditions_text())


@pytest.mark.parametrize(
    ("text", "kind", "value"),
    [("2 %", "share", 0.02), ("0.05 N", "force", 0.05), ("20mN", "force", 0.02),
     (" 0.5 px ", "marker", 0.5)],
)  # fmt: skip
def test_a_tolerance_is_a_number_with_its_unit(text, kind, value):
    read_back = tolerance_of(text)
    assert (read_back.kind, read_back.value) == (kind, pytest.approx(value))
    assert tolerance_of(str(read_back)) == read_back


@pytest.mark.parametrize("text", ["2", "0 %", "-1 N", "2 mm", "nan %", "% 2", "two %", 2.0])
def test_what_is_no_tolerance_is_refused_with_what_is_allowed(text):
    with pytest.raises(SceneError, match=r'tolerance: .*allowed: .*"2 %"'):
        tolerance_of(text)


def test_an_error_bar_comes_from_elements_1_3_times_as_large_or_more():
    for choice in all_choices()[1:]:
        if choice.cells < COARSER_BY * LADDER[0]:
            with pytest.raises(SceneError, match="coarser mesh"):
                companion(choice)
        else:
            assert companion(choice).cells * COARSER_BY <= choice.cells
    assert companion(Choice("layer")).tier == "fem"
    assert Choice("fem", 5).numerics(Body()) == Numerics(spacing=0.8e-3)
    assert Choice("layer").numerics(Body()) is None


def test_features_know_no_units():
    def scene(length, modulus):
        return Scene(
            flat_punch(2 * length, 0.4 * length),
            press_shear_return(0.8 * length, 0.5 * length, steps=2, at=(length, 0)),
            body=Body(20 * length, 18 * length, 4 * length, modulus, 0.4),
            effects=Effects(friction=Friction(0.5)),
        )

    small, large = probe(scene(1e-3, 1e5)), probe(scene(3e-3, 1e6))
    assert small.features.values() == pytest.approx(large.features.values(), rel=2e-2)
    assert large.force == pytest.approx(90 * small.force, rel=1e-3)
    assert small.features.group == "edged shear"


def test_features_say_what_the_scene_is():
    looked = probe(SCENE)
    features = looked.features
    contact = layer_sphere(1e-3, 4e-3, 4e-3, 0.145e6, 0.45).contact_radius
    assert features.contact == pytest.approx(contact / 4e-3, rel=0.1)
    assert features.contact_least < features.contact
    assert (features.depth, features.sharpest, features.width) == pytest.approx((0.25, 1, 5))
    assert (features.friction, features.shear, features.viscous) == (0, 0, 0)
    assert features.group == "smooth press"
    assert looked.force == pytest.approx(0.894, rel=0.01)
    assert looked.marker > 1
    beside = probe(replace(SCENE, motion=press([1e-3], at=(6e-3, 0.0))))
    assert beside.features.side > features.side
    viscous = Effects(viscosity=Viscosity((0.5,), (0.1,)))
    assert probe(replace(SCENE, effects=viscous)).features.group == "viscous"


def test_scenes_are_drawn_alike_from_a_seed_and_share_a_body_in_a_batch():
    for ranges in (TRAINING, HELD_OUT):
        for index in (0, 2, 5):
            scenes = batch(3, index, ranges)
            assert scenes == batch(3, index, ranges)
            assert len(scenes) == BATCH
            assert len({scene.body.thickness for scene in scenes}) == 1
            assert len({scene.effects.key for scene in scenes}) == 1
    assert batch(3, 0, TRAINING) != batch(4, 0, TRAINING)


def test_a_table_comes_back_from_its_file(tmp_path):
    table = made_up(5, 3, unsolved=0.3)
    write(tmp_path / "table.csv", table)
    again = read(tmp_path / "table.csv")
    assert again.conditions == table.conditions
    assert len(again.rows) == len(table.rows)
    for one, other in zip(again.rows, table.rows, strict=True):
        assert one.choice == other.choice
        assert one.features.values() == pytest.approx(other.features.values(), rel=1e-3)
        assert one.error["force"] == pytest.approx(other.error["force"], rel=1e-3)
    assert merged([again, again]).rows == again.rows * 2
    with pytest.raises(ValueError, match="conditions"):
        merged([again, Table({"numerics": "others"}, ())])
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="columns"):
        read(tmp_path / "other.csv")


def test_an_older_table_was_measured_with_the_settings_of_today(tmp_path):
    old = conditions_text()[:-1] + ", planted=Planted(full_integration={}, nodal_contact=False))"
    for on in (False, True):
        path = tmp_path / f"{on}.csv"
        write(path, Table({"meshes": "3 4", "numerics": old.format(on)}, made_up(5, 3).rows))
        found = read(path).conditions
        assert (found["numerics"] == conditions_text()) == (not on)
        assert found["meshes"] == "3 4"


def test_the_stored_tables_were_measured_with_the_settings_of_today():
    for path in (STORED_TRAINING, STORED_HELD_OUT):
        assert "planted" not in path.read_text(encoding="utf-8")
        assert read(path).conditions["numerics"] == conditions_text()


def test_a_quantile_leaves_out_no_more_than_it_may():
    values = np.random.default_rng(0).permutation(100).astype(float)
    assert quantile(values, 0.95) == 95
    assert quantile(values[:19], 0.95) == values[:19].max()
    assert quantile(values[:18], 0.95) == pytest.approx(values[:18].max() + math.log(1.5))
    assert quantile([1.0] * 90 + [math.inf] * 10, 0.95) == math.inf
    assert quantile([], 0.95) == math.inf


def test_promises_and_bars_hold_on_scenes_that_were_not_in_the_table():
    model = fit(made_up(1, 200))
    others = made_up(2, 200)
    checked = validate(model, others)
    assert checked.planned > 120
    for kind in KINDS:
        assert share_kept(checked.chosen(kind)) >= 0.9
    bars = each_bar(model, others)
    assert share_covered(bars) == pytest.approx(PROMISED, abs=0.04)
    wild = replace(
        others, rows=tuple(replace(r, error=dict.fromkeys(KINDS, 9.0)) for r in others.rows)
    )
    assert share_kept(validate(model, wild).chosen()) == 0


def test_a_choice_that_often_finds_no_solution_is_never_promised():
    model = fit(made_up(1, 150, unsolved=0.2))
    features = made_up(1, 1).rows[0].features
    assert math.isinf(model.error(features, Choice("fem", 6), "share"))


def test_finer_meshes_are_predicted_better_and_dearer(planner):
    features = probe(SCENE).features
    errors = [planner.errors.error(features, Choice("fem", cells), "share") for cells in MESHES]
    seconds = [planner.seconds(features, Choice("fem", cells), "cpu") for cells in MESHES]
    assert errors == sorted(errors, reverse=True)
    assert seconds == sorted(seconds)
    assert planner.seconds(features, Choice("layer"), "cpu") < seconds[0]


def test_a_tighter_tolerance_is_never_cheaper(planner):
    plans = [plan(SCENE, f"{percent} %", planner=planner) for percent in (90, 50, 30, 20)]
    assert [one.chosen.seconds for one in plans] == sorted(one.chosen.seconds for one in plans)
    assert plans[0].chosen.choice.tier == "layer"
    assert plans[-1].chosen.choice.tier == "fem"
    for one in plans:
        assert one.chosen.error <= one.tolerance.value
        assert one.cheaper is None or one.cheaper.error > one.tolerance.value
        assert one.dearer is None or one.dearer.error < one.chosen.error
        assert "95 of 100 scenes like this (smooth press)" in one.why
        assert str(one.tolerance) in one.why


def test_newtons_and_pixels_are_promised_in_their_own_units(planner):
    share = plan(SCENE, "30 %", planner=planner)
    looked = share.looked
    newtons = plan(SCENE, f"{0.3 * looked.force} N", planner=planner)
    pixels = plan(SCENE, f"{0.3 * looked.marker} px", planner=planner)
    assert newtons.chosen.choice == pixels.chosen.choice == share.chosen.choice
    assert newtons.chosen.error == pytest.approx(share.chosen.error * looked.force)
    assert newtons.chosen.error != pixels.chosen.error


def test_what_nothing_reaches_is_refused_with_the_best_there_is(planner):
    with pytest.raises(SceneError, match=r"tolerance: '0.001 %'; the best is fem.*or more") as said:
        plan(SCENE, "0.001 %", planner=planner)
    allowed = str(said.value).rpartition("allowed: ")[2].removesuffix(" or more")
    assert plan(SCENE, allowed, planner=planner).within


@pytest.mark.parametrize(
    ("scene", "said"),
    [
        (replace(SCENE, motion=press([3.4e-3])), "depth over thickness is 0.85"),
        (replace(SCENE, body=Body(poisson=0.4999)), r"-log\(1 - 2 nu\) is 8.52"),
        (replace(SCENE, effects=Effects(friction=Friction(5.0))), "coefficient of friction is 5"),
        (replace(SCENE, effects=Effects(inertia=Inertia())), r"effects\.inertia"),
        (replace(SCENE, effects=Effects(gravity=Gravity())), r"effects\.gravity"),
        (replace(SCENE, body=Body(dome_radius=60e-3)), r"body\.dome_radius"),
        (replace(SCENE, motion=through([(0, 0, 0), (1e-3, 0, 0)], speed=1e-2)), "never presses"),
    ],
)  # fmt: skip
def test_a_scene_beyond_the_table_is_refused_by_what_is_beyond(planner, scene, said):
    with pytest.raises(SceneError, match=said):
        plan(scene, "20 %", planner=planner)


def test_a_body_narrower_than_the_tables_only_rules_out_the_layer(planner):
    narrow = replace(SCENE, body=Body(size_x=6.5e-3, size_y=6.5e-3))
    assert planner.errors.outside(probe(narrow).features, "layer")
    assert {offer.choice.tier for offer in plan(narrow, "20 %", planner=planner).offers} == {"fem"}
    assert plan(SCENE, "20 %", planner=planner).offers[0].choice.tier == "layer"


def test_a_device_that_was_never_timed_is_refused(planner):
    with pytest.raises(SceneError, match=r"device: 'cuda:0' with a tolerance; allowed: cpu"):
        plan(SCENE, "20 %", "cuda:0", planner=planner)


def test_a_table_of_other_settings_is_told_of(planner):
    old = replace(planner, numerics="Numerics(of yesterday)")
    assert "other settings" in plan(SCENE, "50 %", planner=old).notes[0]
    assert not plan(SCENE, "50 %", planner=planner).notes


def test_a_loose_tolerance_takes_the_layer_and_says_why(planner):
    result = simulate_within(SCENE, "90 %", planner=planner)
    assert result.tier == "layer"
    assert result.record["plan"]["chosen"].startswith("layer")
    assert result.record["plan"]["tried"] == []
    assert "error_bar" not in result.record


def test_a_tight_tolerance_takes_elements_and_an_error_bar_says_how_far_off(planner):
    scene = replace(SCENE, motion=press([0.6e-3]), body=Body(size_x=12e-3, size_y=12e-3))
    tolerance = 1.001 * min(
        offer.error for offer in plan(scene, "90 %", planner=planner).offers[:4]
    )
    result = simulate_within(scene, f"{100 * tolerance} %", planner=planner, error_bar=True)
    assert result.tier == "fem"
    bar = result.record["error_bar"]
    assert bar["force"] == pytest.approx(bar["factor"]["force"] * bar["difference"]["force"])
    first, second = (record["elements"] for record in (result.record["mesh"], bar["second_mesh"]))
    assert second < first
    assert bar["force_share"] > 0
    assert bar["marker_rms"] > 0


def test_an_error_bar_of_the_layer_comes_from_elements(planner):
    scene = replace(SCENE, motion=press([0.6e-3]), body=Body(size_x=12e-3, size_y=12e-3))
    result = with_error_bar(simulate(scene, "layer"), planner=planner)
    bar = result.record["error_bar"]
    assert bar["second_mesh"]["cells"] == [12, 12, 4]
    assert bar["force"] > bar["difference"]["force"] > 0
    coarse = simulate(scene, numerics=Numerics(spacing=4e-3 / 3))
    with pytest.raises(SceneError, match=r"error_bar: elements of 1.33 mm; allowed: up to 1.03"):
        with_error_bar(coarse, numerics=Numerics(spacing=4e-3 / 3), planner=planner)


def test_a_choice_without_a_solution_is_followed_by_the_next_dearer(planner, monkeypatch):
    asked = []

    def fails_twice(scene, tier, numerics, **_others):
        asked.append(numerics.spacing)
        if len(asked) < 3:
            raise SimulationDiverged("none")
        return simulate(scene, "layer")

    chosen = plan(SCENE, "45 %", planner=planner)
    assert chosen.chosen.choice.tier == "fem"
    run_file = importlib.import_module("sim.planner.plan")
    monkeypatch.setattr(run_file, "simulate_one", fails_twice)
    result = run_file.simulate_within(SCENE, "45 %", planner=planner)
    assert asked == [4e-3 / offer.choice.cells for offer in chosen.within[:3]]
    assert len(result.record["plan"]["tried"]) == 2


def test_seconds_come_back_and_are_fitted(tmp_path, planner):
    path = tmp_path / "seconds.csv"
    write_seconds(path, timed_presses())
    assert read_seconds(path) == [
        replace(one, seconds=float(f"{one.seconds:.4g}")) for one in timed_presses()
    ]
    single = planner.seconds.shares["cpu", "fem", "float32"]
    double = planner.seconds.shares["cpu", "fem", "float64"]
    assert single.min() >= 0
    assert double.sum() == pytest.approx(1.3 * single.sum(), rel=0.2)


def test_a_batch_is_measured_once_and_read_after(tmp_path, monkeypatch):
    campaign = Campaign("training", 9, 2, TRAINING, "cpu", reference_cells=5, ladder=(3,))
    rows = made_up(9, 1).rows
    measured = []

    def pretend(_campaign, index, _say):
        measured.append(index)
        return list(rows)

    monkeypatch.setattr("benchmarks.sim.cost_table.measure.measure_batch", pretend)
    lines = []
    for _ in range(2):
        table = measure(campaign, tmp_path, lines.append)
        assert len(table.rows) == 2 * len(rows)
    assert measured == [0, 1]
    measure(replace(campaign, reference_cells=6), tmp_path, lines.append)
    assert measured == [0, 1, 0, 1]
    assert "left" in lines[0]
    assert len(NAMES) == len(rows[0].features.values())
