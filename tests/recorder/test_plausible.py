"""Values that cannot be true are warned of by what else is in the session; healthy ones are not."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import simplejpeg
from support.few import few
from support.sessions import CONTACT_FRAME, DEPTH, T0, Columns, depth_at, make_session, shear_at

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


def late_at_last(rows: Columns) -> Any:
    value = rows["value"]
    return np.concatenate([value[:6400], value[6250:-150]])


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
    few(
        [
            pytest.param(*each)
            for each in (
                ("wrong-sign", times(1, 1, -1, 1, 1, 1)),
                ("wrong-sign", times(*[-1] * 6)),
                ("impossible", times(*[1e4] * 6)),
                ("impossible", part(times(*[1e300] * 6))),
                ("force-step", part(times(*[0.1] * 6))),
                ("scale", part(times(*[4.448] * 6))),
                ("depth-force", lambda rows: np.roll(rows["value"], 400, axis=0)),
                ("force-time", lambda rows: np.roll(rows["value"], 60, axis=0)),
                ("force-time", lambda rows: np.roll(rows["value"], -150, axis=0)),
                ("force-time", late_at_last),
                ("force-step", part(times(*[-1] * 6))),
                ("held", part(still)),
                (
                    "torque",
                    lambda rows: np.concatenate([rows["value"][:, :3], rows["value"][:, 2::-1]], 1),
                ),
            )
        ],
        6,
    ),
)
def test_a_gauge_that_cannot_be_right_is_named(tmp_path: Path, code: str, edit: Edit) -> None:
    found = warned(edited(tmp_path / "s.zarr", "force", edit))
    assert found[code].startswith("streams/force"), found


@pytest.mark.parametrize("left", [0.1, 0.8])
def test_a_force_on_the_way_to_a_press_is_named(tmp_path: Path, left: float) -> None:
    def change(name: str, columns: Columns) -> Columns:
        value = np.array(columns.get("value", ()), float)
        if name in ("pose", "force"):
            seconds = 1e-9 * (columns["t_ns"] - T0)
            above = (seconds > 3.3) & (seconds < 3.36)
            value[above] = value[above] + np.eye(6)[2] * 1e-3 if name == "pose" else left
            return columns | {"value": value}
        return columns

    path = make_session(tmp_path / "s.zarr", seconds=5.1, names=("force", "pose"), change=change)
    assert ("clear-force" in warned(path)) == (left > 0.5)


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
    few(
        [
            pytest.param(*each)
            for each in (
                ("pose-speed", times(1e3, 1e3, 1e3, 1, 1, 1)),
                ("pose-speed", part(lambda rows: rows["value"] + np.array([2e-3, 0, 0, 0, 0, 0]))),
                ("pose-speed", lambda rows: rows["value"] + np.array([0, 0, 0, 57.3, 0, 0])),
                ("pose-place", still),
                ("pose-place", part(still)),
                ("pose-place", lambda rows: rows["value"] + np.array([0, 4e-4, 0, 0, 0, 0])),
            )
        ],
        3,
    ),
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
    few(
        [
            pytest.param(*each)
            for each in (
                ("dark", lambda images: images // 8),
                ("dark", some_of(lambda images: images // 20)),
                ("still-image", noisy),
                ("image-time", lambda images: np.roll(images, 24, axis=0)),
                ("image-jump", some_of(lambda images: 255 - images)),
                ("turned", some_of(lambda images: images[:, ::-1, ::-1])),
                ("turned", some_of(lambda images: images[..., ::-1])),
                ("still-image", lambda x: np.concatenate([x[:206], noisy(x[206:236]), x[236:]])),
            )
        ],
        4,
    ),
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


def test_a_picture_whose_noise_comes_again_once_is_no_still_one(tmp_path: Path) -> None:
    def change(images: Any) -> Any:
        noise = np.random.default_rng(0).normal(0, 2, images.shape)
        images = np.clip(images + noise, 0, 255).astype(np.uint8)
        images[[5 + 21, 40 + 21]] = images[[5, 40]]  # 0.35 s later
        return images

    path = edited(tmp_path / "s.zarr", "camera", redrawn(change), names=ALL[:3], seconds=3.6)
    assert "still-image" not in warned(path)


@pytest.mark.parametrize("first", [0, 460])
def test_a_dead_taxel_is_named(tmp_path: Path, first: int) -> None:
    def dead(rows: Columns) -> Any:
        value = rows["value"].copy()
        value[first:, 5, 1] = 30_000
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


def mounted(path: Path, **expected: Any) -> dict[str, float]:
    """Return the doubts of a session with these `expected`, by code and stream."""
    session, found = Session(path), dict[str, float]()
    session.attrs["expected"] = expected
    for one in plausible.statements(session):
        name = f"{one.finding.code} {one.finding.where.split('/')[1]}"
        found[name] = max(one.doubt, found.get(name, -np.inf))
    return found


GAUGE = [2e-3, 1e-3, -2e-2]


def at_tip(rows: Columns) -> Any:
    """Return forces with the torques that they have at the tip, about `GAUGE`."""
    seconds = np.arange(len(rows["value"])) / 1000
    tip = np.stack([shear_at(seconds), 0 * seconds, -depth_at(seconds)], axis=1) - GAUGE
    torque = np.cross(tip, rows["value"][:, :3] - 0.25)  # less the reference
    noise = np.random.default_rng(0).normal(0, 5e-5, torque.shape)
    return np.concatenate([rows["value"][:, :3], torque + noise], axis=1)


@pytest.mark.parametrize(
    ("edit", "known", "unknown"),
    few(
        [
            pytest.param(*each)
            for each in (
                (times(*[1] * 6), False, False),
                (times(1, 1, 1, -1, -1, -1), True, False),
                (times(1, 1, 1, 4, 4, 4), True, False),
                (times(4, 1, 1, 1, 1, 1), True, False),
                (columns(0, 1, 2, 4, 3, 5), True, False),
                (times(1, 1, 1, 1e3, 1e3, 1e3), True, True),
            )
        ],
        3,
    ),
)
def test_torques_are_those_of_the_force_at_the_tip(
    tmp_path: Path, edit: Edit, known: bool, unknown: bool
) -> None:
    path = edited(tmp_path / "s.zarr", "force", lambda rows: edit({"value": at_tip(rows)}))
    for expected, doubtful in (({"gauge": GAUGE}, known), ({}, unknown)):
        doubt = mounted(path, **expected)["torque force"]
        assert doubt > 1 if doubtful else doubt <= 0.5


@pytest.mark.parametrize("factors", [(-1, 1), (4, 1), (1, 0.2)])
def test_a_side_axis_is_told_by_two_shears(tmp_path: Path, factors: tuple[float, float]) -> None:
    def change(name: str, rows: Columns) -> Columns:
        if name == "segments":
            return rows
        second = (rows["t_ns"] - rows["t_ns"][0] > 1_600_000_000)[:, None]  # is sheared along y
        origin = np.array(CONTACT_FRAME[:2]) * (name == "pose")
        aside = rows["value"][:, :2] - origin
        aside = np.where(second, aside[:, ::-1], aside) * (factors if name == "force" else 1)
        return {**rows, "value": np.hstack([aside + origin, rows["value"][:, 2:]])}

    path = make_session(tmp_path / "s.zarr", names=("force", "pose"), change=change)
    assert warned(path).get("shear-direction") == "streams/force/value"


def test_a_tool_that_is_turned_is_named(tmp_path: Path) -> None:
    def pose(*turn: float) -> Edit:
        return lambda rows: rows["value"] + np.array([0, 0, 0, *turn])

    some = edited(tmp_path / "some.zarr", "pose", part(pose(0, 0.1, 0)), seconds=3.6)
    assert "pose-speed" in warned(some)
    for turn, doubtful in ((0.1, True), (2 * np.pi, False)):
        path = edited(tmp_path / f"{turn}.zarr", "pose", pose(0, turn, 0), seconds=3.6)
        assert (mounted(path, tool=[0, 0, 0])["pose-place pose"] > 1) == doubtful


@pytest.mark.parametrize(
    ("turned", "change"),
    [
        (0, lambda images: images),
        (180, lambda images: images[:, ::-1, ::-1]),
        (180, lambda images: images[:, :, ::-1]),
    ],
)
def test_a_picture_is_turned_as_the_bench_states(
    tmp_path: Path, turned: float, change: Callable[[Any], Any]
) -> None:
    names, shape = ("camera", "force", "pose"), (128, 160)
    path = edited(
        tmp_path / "s.zarr", "camera", redrawn(change), names=names, shape=shape, seconds=3.6
    )
    for stated in (0, 180):
        doubt = mounted(path, turned=np.radians(stated))["turned camera"]
        assert doubt <= 0.5 if stated == turned else doubt > 1


def pressed_taxels(rows: Columns) -> Any:
    """Return taxels whose sides move outwards under a press."""
    seconds = np.arange(len(rows["value"])) / 60
    side = np.pad(PLACES, ((0, 0), (0, 1)))
    pressed = np.maximum(depth_at(seconds), 0) / DEPTH
    reach = np.exp(-np.linalg.norm(PLACES, axis=1) / 4.7e-3)[:, None]
    return rows["value"] + np.rint(2e5 * reach * side * pressed[:, None, None]).astype(np.int32)


PLACES = 4.7e-3 * (np.stack(np.mgrid[:4, :4][::-1], axis=-1).reshape(-1, 2) - 1.5)


@pytest.mark.parametrize(
    ("code", "edit"),
    few(
        [
            pytest.param(*each)
            for each in (
                ("", lambda value: value),
                ("wrong-sign", lambda value: value * [1, 1, -1] + [0, 0, 60_000]),
                ("turned", lambda value: value * [-1, 1, 1] + [60_000, 0, 0]),
                ("wrong-sign", lambda value: value[..., [2, 1, 0]]),
                (
                    "wrong-sign",
                    lambda value: np.concatenate([value[:96], value[96:, :, [2, 1, 0]]]),
                ),
                (
                    "turned",
                    lambda value: value.reshape(-1, 4, 4, 3)[:, :, ::-1].reshape(value.shape),
                ),
                (
                    "turned",
                    lambda value: value.reshape(-1, 4, 4, 3).swapaxes(1, 2).reshape(value.shape),
                ),
            )
        ],
        3,
    ),
)
def test_axes_and_order_of_taxels_are_told_by_presses(
    tmp_path: Path, code: str, edit: Callable[[Any], Any]
) -> None:
    path = edited(
        tmp_path / "s.zarr",
        "taxels",
        lambda rows: edit(pressed_taxels(rows)).astype(np.int32),
        names=("taxels", "pose"),
        seconds=3.6,
    )
    found = mounted(path, turned=0.0, taxels=PLACES.tolist())
    doubtful = {name for name, doubt in found.items() if not doubt <= 0.5}
    assert f"{code} taxels" in doubtful if code else not doubtful


def test_what_only_a_shear_tells_is_not_verified_without_one(tmp_path: Path) -> None:
    def change(name: str, rows: Columns) -> Columns:
        if name == "segments":
            return {key: values[rows["phase"] % 3 == 0] for key, values in rows.items()}
        return rows

    path = make_session(tmp_path / "s.zarr", names=("camera", "force", "pose"), change=change)
    found = " ".join(str(each) for each in check(path) if each.code == "unverified")
    assert "streams/force/value: side axes and torques not verified" in found
    assert "streams/camera: orientation not verified: the bench does not state it" in found
    assert not [*plausible.doubts(Session(path), looked={})]
