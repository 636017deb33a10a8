"""Plans of simulated archives: the paper's counts, shared deformations, division into units."""

import json
import math
from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from recorder.settings import differing_keys
from rig.bench.bench import BenchFile
from rig.core.packaged import BENCHES
from sim import SceneError
from sim.dataset import DatasetPlan, Solving, gel
from sim.dataset.generate import creep
from sim.dataset.plan import (
    STATES,
    chosen_targets,
    code,
    families,
    force_scale,
    indenter_names,
    names,
    scenes,
    units,
)
from sim.dataset.run import most_of_poisson
from sim.indenters import NAMES
from sim.result import from_json, to_json
from sim.sensors import HETEROGENEOUS, HOMOGENEOUS, MATERIAL, sensor
from tests.support.few import few
from trajectories import PressShear

STATES_PLAN = DatasetPlan("states", (gel(),))


def group(rows: tuple[str, ...], **options: object) -> DatasetPlan:
    return DatasetPlan("targets", tuple(sensor(name) for name in rows), **options)  # type: ignore[arg-type]


def locations(plan: DatasetPlan) -> list[list[tuple[int, int]]]:
    """Return location and phase of every row, by family."""
    return [
        [
            pair
            for press in family.presses
            for one in press.recordings
            for pair in zip(one.locations, one.phases, strict=True)
        ]
        for family in families(plan)
    ]


def test_the_paper_has_810_states_of_12_patterns_and_132_directed_pairs() -> None:
    (family,) = families(STATES_PLAN)
    assert len(NAMES) * STATES == 810
    (found,) = locations(STATES_PLAN)
    assert found == [(location, -1) for location in range(810)]
    assert len(family.presses) == 162
    assert family.recordings * family.rows_each * len(family.names) == 9720
    patterns = names(gel())
    assert len(patterns) == 12
    assert 2 * len(list(combinations(patterns, 2))) == 132
    assert {press.indenter for press in family.presses} == set(NAMES)
    depths = {-z for press in family.presses for _, _, z in press.motion.tip}
    np.testing.assert_allclose(sorted(depths), [0, 0.3e-3, 0.6e-3, 0.9e-3, 1.2e-3, 1.5e-3])


@pytest.mark.parametrize(
    ("rows", "targets", "pairs"),
    [(HOMOGENEOUS, 240, 17_280), (MATERIAL, 48, 3_456), (HETEROGENEOUS, 160, 11_520)],
    ids=["homogeneous", "material", "heterogeneous"],
)
def test_groups_have_the_papers_targets_and_location_pairs(
    rows: tuple[str, ...], targets: int, pairs: int
) -> None:
    plan = group(rows)
    for found in locations(plan):
        placed = {(location, phase) for location, phase in found if location >= 0}
        assert len(placed) == pairs
        assert len({location for location, _ in placed}) == 18 * targets
    assert len({name for family in families(plan) for name in family.names}) == len(rows)


@pytest.mark.parametrize(
    ("bench", "row"),
    [
        *((f"{name}.yaml", name) for name in (*HOMOGENEOUS, *MATERIAL)),
        ("gelsight-hetero.yaml", "gelsight"),
        ("uskin.yaml", "uskin"),
        ("tacpalm.yaml", "tacpalm"),
    ],
)
def test_trajectories_are_those_of_the_benches(bench: str, row: str) -> None:
    read, each = BenchFile.read(BENCHES / bench).bench, sensor(row)
    assert each.trajectory == read.trajectory
    assert each.force_depth is not None
    assert each.force_depth.repeats == 3


@pytest.mark.parametrize("row", ["array-i", "r6", "gelsight"])
@pytest.mark.parametrize("fraction", few([0.02, 0.05, 0.1, 0.3, 0.5], 2))
def test_a_share_of_the_targets_is_spread_evenly(row: str, fraction: float) -> None:
    trajectory = sensor(row).trajectory
    assert isinstance(trajectory, PressShear)
    some = chosen_targets(trajectory, fraction)
    assert len(some) == max(1, round(fraction * len(trajectory)))
    for trait, kinds in (
        ("point", len(trajectory.points)),
        ("depth", trajectory.depth_count),
        ("direction", trajectory.direction_count),
    ):
        often = Counter(getattr(one, trait) for one in some)
        least = 0 if len(often) < kinds else min(often.values())
        assert max(often.values()) - least <= 1, (trait, often)
    assert {one.index for one in some} <= {one.index for one in chosen_targets(trajectory, 0.6)}


def test_a_press_has_as_many_frames_as_the_papers_and_all_of_them_a_phase() -> None:
    (family,) = families(group(("gelsight",), indenters=("sphere",), fraction=0.01))
    first = family.presses[0].recordings[0]
    assert 20 <= family.rows_each <= 60
    assert first.phases == (0,) * 11 + (1,) * 10 + (2,) * 10 + (3,) * 10
    press = family.presses[-1]
    assert press.indenter == "prism"
    assert [one.target for one in press.recordings] == [160, 161, 162]
    for one in press.recordings:
        depth = -np.array(press.motion.tip)[list(one.frames), 2]
        assert len(one) == family.rows_each
        assert one.locations == (-1,) * len(one)
        assert depth[[0, -1]] == pytest.approx(-0.3e-3)
        assert depth.argmax() == 20
        assert depth.max() == pytest.approx(1e-3)
        assert one.phases == (0,) * 21 + (3,) * 20


def test_skins_that_differ_in_modulus_alone_share_their_deformation() -> None:
    plan = group(MATERIAL, fraction=0.05, indenters=("sphere",))
    (family,) = families(plan)
    moduli = [sensor(name).body.modulus for name in MATERIAL]
    found = [force_scale(plan, each) for each in family.sensors]
    np.testing.assert_allclose(np.array(found) / found[0], np.array(moduli) / moduli[0])
    assert {scene.body.modulus for scene in scenes(plan, family, family.presses[:2])} == {145e3}
    in_newton = replace(plan, solving=Solving(tolerance="0.05 N"))
    assert len(families(in_newton)) == len(MATERIAL)


def test_sensors_that_are_mounted_or_held_otherwise_share_nothing() -> None:
    assert len(families(group(HOMOGENEOUS))) == len(HOMOGENEOUS)
    assert len(families(group(HETEROGENEOUS))) == len(HETEROGENEOUS)


@pytest.mark.parametrize("batch_size", [1, 9, 17, 162])
@pytest.mark.parametrize(
    "plan", [STATES_PLAN, group((*HETEROGENEOUS, "r6"), fraction=0.1)], ids=["states", "targets"]
)
def test_units_hold_every_press_and_every_file_once(plan: DatasetPlan, batch_size: int) -> None:
    plan = replace(plan, batch_size=batch_size)
    for index, family in enumerate(families(plan)):
        mine = [unit for unit in units(plan) if unit.family == index]
        presses = [number for unit in mine for number in range(unit.first, unit.last)]
        files = [number for unit in mine for number in unit.files]
        assert presses == list(range(len(family.presses)))
        assert files == list(range(-(-family.recordings // family.unit_presses)))
        for unit in mine:
            rows = sum(len(p.recordings) for p in family.presses[unit.first : unit.last])
            assert (len(unit.files) - 1) * family.unit_presses < rows
            assert rows <= len(unit.files) * family.unit_presses
    assert [unit.number for unit in units(plan)] == list(range(len(units(plan))))


def test_a_part_of_the_indenters_keeps_codes_locations_and_draws() -> None:
    whole, part = group(("array-i",)), group(("array-i",), indenters=("cone", "moon"), fraction=0.1)
    known = {
        (press.indenter, one.target): (one, press.motion)
        for press in families(whole)[0].presses
        for one in press.recordings
    }
    for press in families(part)[0].presses:
        for one in press.recordings:
            assert known[press.indenter, one.target] == (one, press.motion)
    numbers = [one.number for one, _ in known.values()]
    assert len(set(numbers)) == len(numbers)
    assert [code(name) for name in NAMES] == list(range(18))


def test_drawn_indenters_follow_the_18_and_change_nothing_of_them() -> None:
    plain = group(("array-i",), indenters=("cone", "moon"), fraction=0.1)
    more = replace(plain, indenters=("cone", "moon", "drawn-0", "drawn-3"))
    before, after = (families(each)[0].presses for each in (plain, more))
    assert [each for each in after if not each.indenter.startswith("drawn")] == list(before)
    assert indenter_names(more) == (*NAMES, "drawn-0", "drawn-1", "drawn-2", "drawn-3")
    assert code("drawn-3") == 21
    numbers = [one.number for press in after for one in press.recordings]
    assert len(set(numbers)) == len(numbers)
    assert from_json(DatasetPlan, json.loads(json.dumps(to_json(more))), "plan") == more
    few, many = (creep(sensor("array-i"), 0, count) for count in (18, 22))
    np.testing.assert_array_equal(few, many[: len(few)])


@pytest.mark.parametrize(
    "plan",
    [
        STATES_PLAN,
        group((*HETEROGENEOUS, *HOMOGENEOUS), solving=Solving(spacing=1e-3), seed=7),
        group(("r6",), solving=Solving(tolerance="3 %"), fraction=0.3, steps=4),
    ],
)
def test_a_plan_survives_json(plan: DatasetPlan) -> None:
    stored = json.loads(json.dumps(to_json(plan)))
    assert from_json(DatasetPlan, stored, "plan") == plan
    assert differing_keys(stored, to_json(plan)) == []


def test_plans_say_in_which_keys_they_differ() -> None:
    one = group(("gelsight", "uskin"))
    harder = replace(one.sensors[1], body=replace(one.sensors[1].body, modulus=1e6))
    other = replace(one, seed=1, sensors=(one.sensors[0], harder))
    assert differing_keys(to_json(one), to_json(other)) == ["seed", "sensors[1].body.modulus"]
    stored = to_json(one)
    stored["steps"] = 2.5
    with pytest.raises(SceneError, match=r"plan.steps: found 2.5; allowed: a whole number"):
        from_json(DatasetPlan, stored, "plan")
    stored = to_json(one)
    stored["sensors"][1]["signal"]["kind"] = "ears"
    with pytest.raises(SceneError, match=r"signal.kind: found 'ears'; allowed: camera, taxels"):
        from_json(DatasetPlan, stored, "plan")
    del stored["sensors"]
    with pytest.raises(SceneError, match=r"plan: missing sensors; known: "):
        from_json(DatasetPlan, stored, "plan")


@pytest.mark.parametrize(("mean", "most"), [(0.0, 0), (0.5, 6), (10.0, 26)])
def test_a_number_is_rarely_beyond_the_most_of_its_distribution(mean: float, most: int) -> None:
    chances = [math.exp(-mean) * mean**k / math.factorial(k) for k in range(100)]
    assert most_of_poisson(1e-5, mean) == most
    assert sum(chances[most + 1 :]) <= 1e-5
    assert most == 0 or sum(chances[most:]) > 1e-5
