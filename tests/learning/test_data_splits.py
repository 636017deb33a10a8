"""Splits: every press has the same role in all sensors, and a split is stored in a file."""

import argparse
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.made_up_archives import archive_of, made_up_archive
from support.tiny_field import tiny

from learning.data.splits import (
    NO_ROLE,
    ROLES,
    Split,
    make_split,
    presses_of,
    read_split,
    training_split,
)
from learning.errors import LearningError
from learning.train_command import open_data, run_training
from learning.training.run import TrainingSession
from recorder import MarkerArchive, SessionError

SMALL: dict[str, Any] = {"frames_per_phase": 1, "displacement": False}
archive = archive_of(targets=4, force_depth=1, invalid=(3,), **SMALL)


def test_every_location_has_one_role(archive: MarkerArchive) -> None:
    split = make_split(archive, validation=0.25, new_press=0.25)
    by_role = [set(split.locations(role).tolist()) for role in ROLES]
    assert sum(map(len, by_role)) == len(set.union(*by_role)) == 12
    assert [len(each) for each in by_role] == [4, 2, 2, 4]


def test_unseen_indenters_are_never_trained_on(archive: MarkerArchive) -> None:
    split = make_split(archive)
    cone = archive.indenters.index("cone")
    for sensor in archive.values():
        codes = sensor.table["indenter"]
        assert set(codes[split.rows(sensor.table, "new_indenter")].tolist()) == {cone}
        assert cone not in codes[split.rows(sensor.table, ("train", "validation", "new_press"))]


def test_indenters_that_calibrated_are_trained_on_and_no_others(archive: MarkerArchive) -> None:
    held_out = make_split(archive, validation=0.0, new_press=0.0, unseen=("cone", "prism"))
    split = held_out.trained_on(("prism",))
    role = {(each.indenter, each.role) for each in split.presses}
    assert role == {("sphere", "train"), ("prism", "train"), ("cone", "new_indenter")}
    assert split.fingerprint != held_out.fingerprint


def test_rows_are_valid_and_in_order_of_press_and_time(archive: MarkerArchive) -> None:
    split = make_split(archive)
    table = archive["dots"].table
    rows = np.concatenate([split.rows(table, role) for role in ROLES])
    located = np.flatnonzero((table["location"] >= 0) & table["valid"])
    assert np.array_equal(np.sort(rows), located)
    assert 3 not in rows
    ordered = split.rows(table, "train")
    key = table["location"][ordered].astype(np.int64) * 1000 + table["frame"][ordered]
    assert (np.diff(key) > 0).all()


def test_frames_without_a_location_have_no_role(archive: MarkerArchive) -> None:
    split = make_split(archive)
    assert split.role(np.array([-1, 0, 99])).tolist()[::2] == [NO_ROLE, NO_ROLE]
    assert Split(()).role(np.array([0, 1])).tolist() == [NO_ROLE, NO_ROLE]


def test_shares_are_spread_over_indenters(archive: MarkerArchive) -> None:
    split = make_split(archive, validation=0.25, new_press=0.25, unseen=())
    for role in ("validation", "new_press"):
        pressed = [press.indenter for press in split.presses if press.role == role]
        assert sorted(pressed) == ["cone", "prism", "sphere"]


def test_the_same_seed_makes_the_same_split_and_another_one_another(archive: MarkerArchive) -> None:
    assert make_split(archive, seed=1) == make_split(archive, seed=1)
    assert len({make_split(archive, seed=seed).fingerprint for seed in range(5)}) > 1


def test_states_of_one_press_stay_together() -> None:
    # As for simulated states: one frame per location, several locations per press.
    number = np.arange(40)
    table = {
        "location": number,
        "indenter": 0 * number,
        "target": number // 5,
        "seen": number >= 0,
        "valid": number >= 0,
        "frame": number % 5,
    }

    class States(dict):  # type: ignore[type-arg]
        name, indenters = "states", ("sphere",)

    states: Any = States(gel=SimpleNamespace(table=table))
    split = make_split(states, validation=0.2, new_press=0.2)
    for target in range(8):
        assert len({press.role for press in split.presses if press.target == target}) == 1
    assert {press.role for press in split.presses} == {"train", "validation", "new_press"}


def test_a_file_holds_all_of_it(archive: MarkerArchive, tmp_path: Path) -> None:
    split = make_split(archive, held_out_sensors=("grid",), seed=3)
    path = tmp_path / "split.json"
    split.write(path)
    assert read_split(path) == split
    assert read_split(path).fingerprint == split.fingerprint
    assert split.trained_sensors(archive) == ("dots",)
    split.write(path)
    with pytest.raises(LearningError, match="holds another split"):
        make_split(archive, seed=4, held_out_sensors=()).write(path)
    assert read_split(path) == split


def test_a_split_knows_archives_of_its_presses(archive: MarkerArchive, tmp_path: Path) -> None:
    split = make_split(archive)
    split.check(archive)
    path, dots = tmp_path / "part.markers.zarr", ("dots",)
    part = made_up_archive(path, dots, ("sphere",), (), targets=4, **SMALL)
    split.check(part)
    with pytest.raises(LearningError, match=r"location 4 \(cone, target 0\) is not in the split"):
        make_split(part, unseen=()).check(archive)
    other = made_up_archive(tmp_path / "other.markers.zarr", dots, targets=3, **SMALL)
    with pytest.raises(LearningError, match="location 3 to be target 0 of cone; the split knows"):
        split.check(other)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"validation": 1.0}, "validation: found 1.0; allowed: 0 to less than 1"),
        ({"new_press": -0.1}, "new_press: found -0.1"),
        ({"validation": 0.5, "new_press": 0.5}, "fractions that leave some to train"),
        ({"unseen": ("ball",)}, "unseen: found ball; allowed: sphere, cone, prism"),
        ({"held_out_sensors": ("gel",)}, "held_out_sensors: found gel; allowed: dots, grid"),
    ],
)
def test_wrong_choices_are_refused(
    archive: MarkerArchive, options: dict[str, object], message: str
) -> None:
    with pytest.raises(LearningError, match=message):
        make_split(archive, **options)  # type: ignore[arg-type]


def test_an_unfinished_archive_is_refused(tmp_path: Path) -> None:
    half = made_up_archive(tmp_path / "half.markers.zarr", ("dots",), finish=False, **SMALL)
    with pytest.raises(SessionError, match="still being written"):
        presses_of(half)


def test_a_press_with_two_roles_is_refused(archive: MarkerArchive, tmp_path: Path) -> None:
    path = tmp_path / "split.json"
    make_split(archive).write(path)
    document = json.loads(path.read_text())
    document["presses"]["validation"]["sphere"] = [[0, 0]]
    document["presses"]["train"]["sphere"] = [[0, 0]]
    path.write_text(json.dumps(document))
    with pytest.raises(LearningError, match="found a location twice"):
        read_split(path)


def test_trainings_without_split_make_the_same_one(archive: MarkerArchive, tmp_path: Path) -> None:
    assert training_split(archive) == make_split(archive)
    other = training_split(archive, unseen=["sphere"])
    assert {each.indenter for each in other.presses if each.role == "new_indenter"} == {"sphere"}
    other.write(tmp_path / "split.json")
    assert training_split(archive, tmp_path / "split.json") == other
    with pytest.raises(LearningError, match="--unseen: found with --split"):
        training_split(archive, tmp_path / "split.json", ["sphere"])


def test_a_training_keeps_its_split_in_its_folder(
    archive: MarkerArchive, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = argparse.Namespace(
        archive=archive.path, split=None, unseen=None, out=tmp_path / "run", resume=False
    )
    opened, split = open_data(options)

    def train(session: TrainingSession) -> None:
        session.run.finish(1, {"model": {"w": torch.zeros(1)}})

    run_training(options.out, "field", tiny(), [opened.name], train, split=split)
    assert read_split(tmp_path / "run" / "split.json") == make_split(archive)
    assert f"split.json: sha256 {split.fingerprint[:12]}" in capsys.readouterr().err
