"""Alignment against its definition, written out one query at a time."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from support.sessions import edit_json, make_session, reseal

from recorder.session.align import (
    captured,
    held,
    linear,
    mean,
    nearest,
    pose,
    quaternion,
    rotation_vector,
    source,
)
from recorder.session.frames import frames_table
from recorder.session.loss import Losses
from recorder.session.reader import Session
from recorder.spec import Traits

LATE = 5_000_000_000_000_000  # [ns]; float64 resolves only 1 ns here, in seconds * 1e9
instants = st.integers(0, 40)
sample_times = st.lists(instants, max_size=12).map(
    lambda times: np.sort(LATE + np.array(times, np.int64))
)
query_times = st.lists(st.integers(-5, 45), max_size=12).map(
    lambda times: LATE + np.array(times, np.int64)
)
ages = st.one_of(st.just(np.inf), st.integers(0, 20).map(lambda ns: ns * 1e-9 + 1e-12))


def latest_before(times: Any, moment: int) -> int:
    return max((i for i, t in enumerate(times) if t <= moment), default=-1)


def earlier_of_the_nearest(times: Any, moment: int) -> int:
    order = sorted(range(len(times)), key=lambda i: (abs(int(times[i] - moment)), times[i], -i))
    return order[0] if order else -1


@pytest.mark.parametrize(
    ("method", "definition"), [(held, latest_before), (nearest, earlier_of_the_nearest)]
)
@given(times=sample_times, query=query_times, max_age=ages)
def test_held_is_the_latest_sample_before_and_nearest_the_earlier_of_two(
    method: Any, definition: Any, times: Any, query: Any, max_age: float
) -> None:
    result = method(times, query, max_age=max_age)
    for place, moment in enumerate(query):
        expected = definition(times, moment)
        assert result.index[place] == expected
        assert_age(result, place, times, moment, expected, max_age)


def assert_age(result: Any, place: int, times: Any, moment: int, index: int, limit: float) -> None:
    if index < 0:
        assert np.isnan(result.age[place])
        assert not result.valid[place]
    else:
        age = int(moment - times[index]) * 1e-9
        assert result.age[place] == pytest.approx(age, abs=1e-15)
        assert result.valid[place] == (abs(age) <= limit)


@given(sample_times, query_times, ages)
def test_linear_lies_on_the_line_between_its_neighbours(
    times: Any, query: Any, max_age: float
) -> None:
    values = np.random.default_rng(0).normal(size=(len(times), 2))
    result = linear(times, values, query, max_age=max_age)
    for place, moment in enumerate(query):
        if not len(times) or not times[0] <= moment <= times[-1]:
            assert np.isnan(result.value[place]).all()
            assert not result.valid[place]
            continue
        lower = max(i for i, t in enumerate(times) if t <= moment)
        upper = lower if times[lower] == moment else lower + 1
        gap = int(times[upper] - times[lower])
        weight = int(moment - times[lower]) / gap if gap else 0.0
        expected = values[lower] + weight * (values[upper] - values[lower])
        np.testing.assert_allclose(result.value[place], expected, rtol=1e-12, atol=1e-12)
        sides = int(moment - times[lower]), int(times[upper] - moment)
        assert result.age[place] == pytest.approx(min(sides) * 1e-9, abs=1e-15)
        assert result.valid[place] == (max(sides) * 1e-9 <= max_age)


@given(sample_times, query_times, st.integers(0, 10), ages)
@example(LATE + np.array([5, 9]), LATE + np.array([10]), 10, 4e-9)
def test_mean_is_that_of_the_samples_inside_or_else_the_line(
    times: Any, stop: Any, length: int, max_age: float
) -> None:
    values = np.random.default_rng(1).normal(size=(len(times), 2))
    start = stop - length
    result = mean(times, values, start, stop, max_age=max_age)
    middle = linear(times, values, start + length // 2, max_age=max_age)
    for place in range(len(stop)):
        inside = [i for i, t in enumerate(times) if start[place] <= t <= stop[place]]
        if inside:
            np.testing.assert_allclose(result.value[place], values[inside].mean(axis=0), atol=1e-12)
            age = int(stop[place] - times[inside[-1]]) * 1e-9
            lead = int(times[inside[0]] - start[place]) * 1e-9
            assert result.age[place] == pytest.approx(age, abs=1e-15)
            assert result.valid[place] == (max(age, lead) <= max_age)
        else:
            np.testing.assert_array_equal(result.value[place], middle.value[place])
            assert result.valid[place] == middle.valid[place]


def test_one_nan_reaches_no_further_than_the_means_it_lies_in() -> None:
    times = LATE + np.arange(100, dtype=np.int64)
    values = np.ones((100, 1))
    values[50] = np.nan
    stop = times[10:]
    result = mean(times, values, stop - 5, stop)
    np.testing.assert_array_equal(
        np.isnan(result.value[:, 0]), (stop >= times[50]) & (stop - 5 <= times[50])
    )


vectors = hnp.arrays(np.float64, 3, elements=st.floats(-3, 3)).filter(
    lambda v: 1e-6 < np.linalg.norm(v) < np.pi
)
directions = hnp.arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(
    lambda v: np.linalg.norm(v) > 0.1
)


def matrix(vector: Any) -> Any:
    """Return the rotation matrix of a rotation vector, by Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def interpolated(first: Any, second: Any, weight: float) -> Any:
    """Return the rotation vector at `weight` between two, computed by `pose`."""
    poses = np.concatenate([np.zeros((2, 3)), [first, second]], axis=1)
    times = np.array([LATE, LATE + 1000], np.int64)
    return pose(times, poses, np.array([LATE + round(1000 * weight)])).value[0, 3:]


@given(vectors)
def test_rotation_vectors_survive_the_way_through_quaternions(vector: Any) -> None:
    back = rotation_vector(quaternion(vector[None]))[0]
    np.testing.assert_allclose(matrix(back), matrix(vector), atol=1e-12)
    assert np.linalg.norm(back) <= np.pi + 1e-12


@given(directions, st.floats(-1e-7, 1e-7), st.floats(0, 1))
def test_interpolation_is_smooth_where_the_rotation_vector_wraps(
    axis: Any, off: float, weight: float
) -> None:
    """At pi the vector jumps from v to v - 2 pi axis, the same rotation; no spin may result."""
    axis = axis / np.linalg.norm(axis)
    first, second = (np.pi - 0.01) * axis, -(np.pi - 0.01 + off) * axis
    weight = round(1000 * weight) / 1000
    expected = (np.pi - 0.01 + weight * (0.02 - off)) * axis
    found = interpolated(first, second, weight)
    np.testing.assert_allclose(matrix(found), matrix(expected), atol=1e-9)


@given(vectors, directions, st.floats(0.01, 3.0), st.floats(0, 1))
def test_interpolation_turns_at_a_constant_rate_about_one_axis(
    start: Any, axis: Any, angle: float, weight: float
) -> None:
    axis = axis / np.linalg.norm(axis)
    weight = round(1000 * weight) / 1000
    end = rotation_of(matrix(angle * axis) @ matrix(start))
    expected = matrix(weight * angle * axis) @ matrix(start)
    np.testing.assert_allclose(matrix(interpolated(start, end, weight)), expected, atol=1e-7)


@given(vectors, vectors, st.floats(0, 1))
def test_a_vector_and_its_wrap_interpolate_alike(first: Any, second: Any, weight: float) -> None:
    wrapped = second - 2 * np.pi * second / np.linalg.norm(second)
    angle = np.linalg.norm(rotation_of(matrix(first).T @ matrix(second)))
    if angle > np.pi - 1e-3:
        return  # half a turn apart: both directions are equally short
    plain, other = interpolated(first, second, weight), interpolated(first, wrapped, weight)
    np.testing.assert_allclose(matrix(plain), matrix(other), atol=1e-9)


def rotation_of(rotation: Any) -> Any:
    """Return the rotation vector of a matrix: its axis from the symmetric part, robust at pi."""
    cosine = (np.trace(rotation) - 1) / 2
    skew = np.array([rotation[2, 1], rotation[0, 2], rotation[1, 0]]) - np.array(
        [rotation[1, 2], rotation[2, 0], rotation[0, 1]]
    )
    angle = np.arctan2(np.linalg.norm(skew) / 2, cosine)
    if angle < 3:
        return skew / 2 * (angle / np.sin(angle)) if angle > 1e-9 else skew / 2
    outer = (rotation + rotation.T) / 2 - cosine * np.eye(3)
    axis = outer[:, np.argmax(np.diag(outer))]
    axis = axis / np.linalg.norm(axis)
    return angle * axis * (1.0 if axis @ skew >= 0 else -1.0)


def test_positions_move_on_straight_lines() -> None:
    poses = np.array([[0, 0, 0, 0, 0, 3.0], [1, 2, 4, 0, 0, -3.0]])
    result = pose(np.array([0, 1000]), poses, np.array([250]))
    np.testing.assert_allclose(result.value[0, :3], [0.25, 0.5, 1.0])
    assert abs(result.value[0, 5]) > 3


# ------------------------------------------------------------------------------------ captures


def stream_of(
    kind: str, clock: str, stamp: str = "end", rate_hz: float = 50.0, **attrs: Any
) -> Any:
    """A stream of three rows, which arrive 20 ms apart, 7 ms after the device's own times."""
    arrived = LATE + np.array([0, 20_000_000, 40_000_000])
    columns = {
        "device_t": np.array([arrived[0] * 1e-9 - 0.007, np.nan, arrived[2] * 1e-9 - 0.007]),
        "value": np.array([[1.0], [2.0], [3.0]]),
    }
    return SimpleNamespace(
        name=kind,
        traits=Traits(kind, "latest", ("signal",), clock, stamp),
        t_ns=arrived,
        names=tuple(columns),
        array=columns.__getitem__,
        value_column=SimpleNamespace(is_number=True, is_pose=False),
        rate_hz=rate_hz,
        attrs=attrs,
    )


def test_a_capture_is_the_arrival_less_the_latency_of_a_clock_of_its_own() -> None:
    for clock in ("device", "none"):
        stream = stream_of("camera", clock, latency=0.003, exposure=0.01)
        np.testing.assert_array_equal(captured(stream), stream.t_ns - 3_000_000)
    stream = stream_of("camera", "none")
    np.testing.assert_array_equal(captured(stream), stream.t_ns)


@pytest.mark.parametrize(
    ("stamp", "attrs", "after_ns"),
    [
        ("start", {"exposure": 0.01}, 10_000_000),
        ("middle", {"exposure": 0.01}, 5_000_000),
        ("end", {"exposure": 0.01}, 0),
        ("start", {"exposure": None}, 16_666_667),
        ("start", {}, 16_666_667),
    ],
)
def test_a_capture_by_the_hosts_clock_is_the_end_of_the_exposure(
    stamp: str, attrs: dict[str, Any], after_ns: int
) -> None:
    stream = stream_of("camera", "monotonic", stamp, latency=0.003, **attrs)
    due = stream.t_ns - 7_000_000 + after_ns
    due[1] = stream.t_ns[1] - 3_000_000  # its own time is unknown
    np.testing.assert_allclose(captured(stream), due, rtol=0, atol=2)


def test_a_source_is_in_the_order_of_its_captures_and_holds_a_value_for_two_periods() -> None:
    stream = stream_of("values", "none", rate_hz=4.0, exposure=0.01)
    stream.t_ns = stream.t_ns[[1, 0, 2]]
    rows = source(stream, slice(0, 3), Losses.none("sequence"))
    np.testing.assert_array_equal(rows.times, np.sort(stream.t_ns))
    assert rows.rows.tolist() == [1, 0, 2]
    assert rows.values is not None
    assert rows.values.ravel().tolist() == [2.0, 1.0, 3.0]
    assert rows.max_age == pytest.approx(0.5)
    assert rows.exposure == pytest.approx(0.01)
    assert not rows.is_pose
    assert source(stream, slice(1, 3), Losses.none("sequence")).rows.tolist() == [1, 2]
    limited = stream_of("values", "none", rate_hz=4.0, max_age=0.25)
    assert source(limited, slice(0, 3), Losses.none("sequence")).max_age == 0.25


def test_rows_are_not_valid_if_a_sample_that_they_need_is_bad(tmp_path: Path) -> None:
    def change(name: str, columns: dict[str, Any]) -> dict[str, Any]:
        if name == "force":
            columns["value"][500, 2] = np.nan
            columns["value"][1000, 0] = 2e5
            columns["status"][1500] = 1 << 17
            columns["status"][2000] = 1 << 16  # a warning
        return columns

    path = make_session(tmp_path / "s.zarr", names=("force", "pose"), change=change)
    edit_json(
        path / "streams/force/zarr.json", lambda one: one["attributes"].update(untrusted=1 << 17)
    )
    reseal(path)
    table = frames_table(Session(path), 40)
    t_ns = Session(path).streams["force"].t_ns
    for row, valid in ((500, False), (1000, False), (1500, False), (2000, True), (2500, True)):
        near = int(np.abs(table["t_ns"] - t_ns[row]).argmin())
        assert table["valid"][max(near - 1, 0) : near + 2].all() == valid
    assert table["valid"].mean() > 0.9
