"""Values that cannot be true are warned of by what else is in the session; healthy ones are not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from support.sessions import DEPTH, T0, Columns, make_session

from recorder.checks import plausible
from recorder.checks.check import check
from recorder.session import SessionWriter
from recorder.session.reader import Session

Edit = Callable[[Columns], Any]
ALL = ("camera", "force", "pose", "taxels")
# Five presses, for witnesses that need several.
LONG = 8.4


def edited(path: Path, stream: str, edit: Edit, *, seconds: float = LONG, **more: Any) -> Path:
    """Record a session whose stream was edited before it was written."""

    def change(name: str, columns: Columns) -> Columns:
        if name == stream:
            columns = dict(columns)
            columns["value"] = edit(columns)
        return columns

    names = more.pop("names", ("force", "pose"))
    return make_session(path, seconds=seconds, names=names, change=change, **more)


def warned(path: Path) -> dict[str, str]:
    """Return the place of each warning, by code."""
    return {each.code: each.where for each in check(path) if each.level == "warning"}


def columns(*order: int) -> Edit:
    """Exchange columns."""
    return lambda rows: rows["value"][:, list(order)]


def times(*factors: float) -> Edit:
    """Multiply columns by factors."""
    return lambda rows: rows["value"] * np.array(factors)


def part(edit: Edit) -> Edit:
    """Edit only half a second of a stream, in a press."""

    def some(rows: Columns) -> Any:
        value = rows["value"].copy()
        count = len(value)
        inside = slice(int(3.6 / LONG * count), int(4.1 / LONG * count))
        value[inside] = edit({"value": value})[inside]
        return value

    return some


def still(rows: Columns) -> Any:
    return np.repeat(rows["value"][:1], len(rows["value"]), axis=0)


def test_healthy_sessions_leave_all_witnesses_at_half_of_their_thresholds(tmp_path: Path) -> None:
    for number, names in enumerate((ALL, ("force", "pose"), ("camera",), ("camera", "force"))):
        path = make_session(tmp_path / f"{number}.zarr", seconds=LONG, names=names)
        seen = list(plausible.statements(Session(path)))
        assert {one.finding.code: one.doubt for one in seen if not one.doubt <= 0.5} == {}
    assert warned(path) == {}


@pytest.mark.parametrize(
    ("code", "edit"),
    [
        ("wrong-sign", times(1, 1, -1, 1, 1, 1)),
        ("wrong-sign", times(*[-1] * 6)),
        ("impossible", times(*[1e4] * 6)),
        ("impossible", part(times(*[1e300] * 6))),
        ("scale", part(times(*[0.1] * 6))),
        ("scale", part(times(*[4.448] * 6))),
        ("depth-force", lambda rows: np.roll(rows["value"], 400, axis=0)),
        ("force-time", lambda rows: np.roll(rows["value"], 60, axis=0)),
        ("force-time", lambda rows: np.roll(rows["value"], -150, axis=0)),
        ("force-step", part(times(*[-1] * 6))),
        ("held", part(still)),
        ("torque", lambda rows: np.concatenate([rows["value"][:, :3], rows["value"][:, 2::-1]], 1)),
    ],
)
def test_a_gauge_that_cannot_be_right_is_named(tmp_path: Path, code: str, edit: Edit) -> None:
    found = warned(edited(tmp_path / "s.zarr", "force", edit))
    assert found[code].startswith("streams/force"), found


@pytest.mark.parametrize("left", [0.0, 0.8])
def test_a_force_that_stays_where_nothing_is_touched_is_named(tmp_path: Path, left: float) -> None:
    def change(name: str, columns: Columns) -> Columns:
        columns = dict(columns)
        if name == "segments":
            return {key: values[:12] for key, values in columns.items()}  # three presses
        above = columns["t_ns"] > columns["t_ns"][0] + 5_000_000_000
        value = np.array(columns["value"], float)
        if name == "pose":
            value[above, 2] = value[:, 2].max() + 5e-3
        else:
            value[above] = value[:1] + np.array([0, left, 0, 0, 0, 0])
        return columns | {"value": value}

    path = make_session(tmp_path / "s.zarr", seconds=LONG, names=("force", "pose"), change=change)
    assert ("clear-force" in warned(path)) == (left > 0.5)


@pytest.mark.parametrize(
    ("code", "edit"),
    [
        ("pose-speed", times(1e3, 1e3, 1e3, 1, 1, 1)),
        ("pose-speed", part(lambda rows: rows["value"] + np.array([2e-3, 0, 0, 0, 0, 0]))),
        ("pose-speed", lambda rows: rows["value"] + np.array([0, 0, 0, 57.3, 0, 0])),
        ("pose-place", still),
        ("pose-place", part(still)),
        ("pose-place", lambda rows: rows["value"] + np.array([0, 4e-4, 0, 0, 0, 0])),
    ],
)
def test_an_arm_that_cannot_be_there_is_named(tmp_path: Path, code: str, edit: Edit) -> None:
    found = warned(edited(tmp_path / "s.zarr", "pose", edit))
    assert found[code] == "streams/pose/value", found


def redrawn(change: Callable[[Any], Any]) -> Edit:
    """Change the pixels of pictures (n, h, w, 3) that are stored as JPEG."""

    def edit(rows: Columns) -> Any:
        images = np.array([simplejpeg.decode_jpeg(data) for data in rows["value"]])
        return [simplejpeg.encode_jpeg(np.ascontiguousarray(one)) for one in change(images)]

    return edit


def some_of(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    def edit(images: Any) -> Any:
        images = images.copy()
        images[292:388] = change(images)[292:388]  # from one release to the next
        return images

    return edit


def noisy(images: Any) -> Any:
    noise = np.random.default_rng(0).normal(0, 2, images.shape)
    return np.clip(images[:1] + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("code", "change"),
    [
        ("dark", lambda images: images // 20),
        ("dark", some_of(lambda images: images // 20)),
        ("still-image", noisy),
        ("image-time", lambda images: np.roll(images, 24, axis=0)),
        ("image-jump", some_of(lambda images: 255 - images)),
        ("turned", some_of(lambda images: images[:, ::-1, ::-1])),
    ],
)
def test_pictures_that_cannot_be_right_are_named(
    tmp_path: Path, code: str, change: Callable[[Any], Any]
) -> None:
    names = ("camera", "force", "pose")
    shape = (128, 160)
    found = warned(edited(tmp_path / "s.zarr", "camera", redrawn(change), names=names, shape=shape))
    assert found[code] == "streams/camera", found


def test_taxels_of_another_time_are_named(tmp_path: Path) -> None:
    late = edited(
        tmp_path / "s.zarr", "taxels", lambda rows: np.roll(rows["value"], 8, axis=0), names=ALL
    )
    assert warned(late)["image-time"] == "streams/taxels"


def test_a_dead_taxel_is_named(tmp_path: Path) -> None:
    def dead(rows: Columns) -> Any:
        value = rows["value"].copy()
        value[:, 5, 1] = 30_000
        return value

    path = edited(tmp_path / "s.zarr", "taxels", dead, names=("taxels", "force", "pose"))
    assert warned(path) == {"dead-taxel": "streams/taxels"}


def test_forces_are_held_against_those_expected_of_the_skin(tmp_path: Path) -> None:
    path = make_session(tmp_path / "s.zarr", seconds=LONG, names=("force", "pose"))
    session = Session(path)
    for factor, doubtful in ((1.0, False), (1.8, False), (4.448, True), (1000.0, True)):
        forces = [[2.5 / factor, 3.5 / factor]]
        session.attrs["expected_force"] = {"depths": [DEPTH], "forces": forces}
        seen = [one for one in plausible.statements(session) if "expected" in one.finding.message]
        assert [one.doubtful for one in seen] == [doubtful]
        if doubtful:
            assert f"({factor:.4g})"[:4] in seen[0].finding.message


def controlled(path: Path, stream: str = "", edit: Callable[[Any], Any] = lambda row: row) -> Path:
    """Record four presses at one place, and a control press of which a stream is edited."""

    def change(name: str, rows: Columns) -> Columns:
        if name == stream:
            first = int(np.searchsorted(rows["t_ns"], T0 + 6_000_000_000))
            rows["value"] = [*rows["value"][:first], *map(edit, rows["value"][first:])]
        return rows

    targets = {"point": np.zeros(5, np.int16), "depth": np.full(5, DEPTH)}
    targets["control"] = np.array([-1] * 4 + [0], np.int32)
    make_session(path, seconds=LONG, change=change, finish=False, targets=targets)
    first = {name: values[0] for name, values in Session(path).reference.items()}
    with SessionWriter.resume(path) as writer:
        writer.reference.append(**{**first, "image": 384, "t_ns": T0 + 6_400_000_000})
        writer.finish("complete", rate_hz=40)
    return path


def aside(jpeg: bytes) -> bytes:
    return simplejpeg.encode_jpeg(np.roll(simplejpeg.decode_jpeg(jpeg), 1, axis=1), quality=90)


@pytest.mark.parametrize(
    ("stream", "edit", "where"),
    [
        ("force", lambda wrench: 1.03 * wrench, None),
        ("force", lambda wrench: 0.9 * wrench, "streams/force/value"),
        ("camera", aside, "streams/camera"),
    ],
)
def test_a_control_press_that_differs_is_named(
    tmp_path: Path, stream: str, edit: Callable[[Any], Any], where: str | None
) -> None:
    assert warned(controlled(tmp_path / "s.zarr", stream, edit)).get("control") == where


def test_a_control_press_is_no_target_of_the_plan(tmp_path: Path) -> None:
    path = controlled(tmp_path / "s.zarr")
    session = Session(path)
    seen = [one.doubt for one in plausible.statements(session) if one.finding.code == "control"]
    assert (len(seen), max(seen) < 0.5) == (2, True)
    assert len(session.plan_targets["point"]) == len(session.targets["point"]) - 1 == 4
    assert set(session.segments["target"]) == {0, 1, 2, 3, 4} > set(session.frames["target"])
    assert {each.level for each in check(path)} == {"note"}


def test_a_picture_that_no_reader_decodes_is_a_fault(tmp_path: Path) -> None:
    def torn(rows: Columns) -> Any:
        images = list(rows["value"])
        images[7] = images[7][: len(images[7]) // 2] + b"\xff\xd9"
        return images

    path = edited(tmp_path / "s.zarr", "camera", torn, seconds=3.6, names=("camera", "force"))
    found = [each for each in check(path) if each.code == "bad-image"]
    assert [(each.level, each.where) for each in found] == [("fault", "streams/camera")]
    assert found[0].message.startswith("row 7: cannot be decoded")
