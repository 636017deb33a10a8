"""The stored table: measured with today's solver, and its promises hold on other scenes."""

import pytest

from benchmarks.sim.cost_table.measure import conditions_text
from benchmarks.sim.cost_table.validation import each_bar, share_covered, share_kept, validate
from sim.indenters import sphere
from sim.planner import error_model as table_file
from sim.planner.error_model import fit
from sim.planner.plan import plan, stored
from sim.scene import Scene, press


@pytest.fixture(scope="module")
def checked():
    model = fit(table_file.read(table_file.TRAINING))
    return model, table_file.read(table_file.HELD_OUT)


def test_the_table_was_measured_with_todays_settings():
    for path in (table_file.TRAINING, table_file.HELD_OUT):
        assert table_file.read(path).conditions["numerics"] == conditions_text(), (
            "sim.fem.numerics has changed: run `make cost-table`"
        )


def test_no_scene_of_the_check_is_in_the_table():
    names = [
        {row.scene for row in table_file.read(path).rows}
        for path in (table_file.TRAINING, table_file.HELD_OUT)
    ]
    assert names[0]
    assert names[1]
    assert not names[0] & names[1]


def test_promises_hold_on_a_hundred_other_scenes(checked):
    validation = validate(*checked)
    assert validation.planned >= 100
    assert share_kept(validation.chosen()) >= 0.9


def test_error_bars_cover_the_error_as_often(checked):
    assert share_covered(each_bar(*checked)) >= 0.9


def test_the_papers_sphere_is_planned_by_the_stored_table():
    scene = Scene(sphere(4e-3), press([0.5e-3, 1e-3, 1.5e-3]))
    loose, tight = plan(scene, "20 %"), plan(scene, "5 %")
    assert loose.chosen.seconds <= tight.chosen.seconds
    assert not loose.notes
    assert stored() is stored()
