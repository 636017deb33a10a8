import dataclasses

import numpy as np
import pytest

from benchmarks.fake_clock import FakeClock
from rig.core.geometry import transform
from rig.core.guard import (
    AXES,
    ForceGuard,
    GuardLimits,
    MotionGuard,
    judge_safety,
    most_serious,
    outside_box,
)
from rig.core.samples import FORCE_LATEST, POSE_LATEST
from trajectories import dome_height

RATING = (10.0, 11.0, 12.0, 0.1, 0.2, 0.3)
BOX = ((-0.02, -0.03, -0.001), (0.02, 0.03, 0.1))
FRAME = (0.4, -0.1, 0.2, 0.0, 0.0, 0.5)
LIMITS = GuardLimits(force_rating=RATING, box=BOX, force_status_mask=0x20000)
MS = 1_000_000


def force(t_ns: int, value=(0.0,) * 6, status: int = 0):
    record = np.zeros((), FORCE_LATEST)
    record["t_ns"], record["status"], record["value"] = t_ns, status, value
    return record.reshape(1)


def pose(t_ns: int, place=(0.0, 0.0, 0.01), safety: int = 1):
    """Return a pose record with the TCP at `place` in the contact frame."""
    record = np.zeros((), POSE_LATEST)
    record["t_ns"], record["safety_status"] = t_ns, safety
    record["value"][:3] = transform(FRAME, place)
    return record.reshape(1)


class Guard:
    """The guards of a bench with one gauge, asked together, as the arm's process asks them."""

    def __init__(self, limits: GuardLimits, frame) -> None:
        self.force, self.motion = ForceGuard(limits), MotionGuard(limits, frame)

    def check(self, now_ns, forces, poses, mode="guarded"):
        reasons = (self.force.check(now_ns, forces, mode), self.motion.check(now_ns, poses, mode))
        return most_serious(reason for reason in reasons if reason is not None)


def check(guard: Guard, clock: FakeClock, value=(0.0,) * 6, mode="guarded", **place):
    now_ns = clock.now_ns()
    return guard.check(now_ns, force(now_ns, value), pose(now_ns, **place), mode)


def ramp(rate: float, mode, limits=LIMITS, torque=0.0):
    """Apply Fz growing at `rate` [N/s], sampled at 4 ms; return the violation and its load."""
    guard, clock = Guard(limits, FRAME), FakeClock()
    for _ in range(400):
        clock.advance(0.004)
        load = rate * clock.now_ns() / 1e9
        violation = check(guard, clock, (0, 0, load, *[torque] * 3), mode)
        if violation is not None:
            return violation, abs(load) / RATING[2]
    raise AssertionError("nothing was wrong")


@pytest.mark.parametrize("axis", range(6))
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(
    ("fraction", "kind"), [(0.849, None), (0.851, "force_soft"), (1.001, "force_hard")]
)
def test_each_axis_and_sign_has_its_limits(axis, sign, fraction, kind):
    value = np.zeros(6)
    value[axis] = sign * fraction * RATING[axis]
    violation = check(Guard(LIMITS, FRAME), FakeClock(), value)
    assert (violation and violation.kind) == kind
    in_travel = check(Guard(LIMITS, FRAME), FakeClock(), value, "travel")
    assert (in_travel and in_travel.kind) == kind
    if violation:
        name, unit = AXES[axis]
        assert violation.reason.startswith(f"{name}: ")
        assert unit in violation.reason


@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize(
    ("rate", "mode", "kind", "fraction", "within"),
    [
        # 100 N/s for 20 ms is 2 N of 12 N: about a sixth of the rating early.
        (100.0, "guarded", "force_soft", 0.85 - 2 / 12, 0.04),
        (10.0, "guarded", "force_soft", 0.85 - 0.2 / 12, 0.01),
        (100.0, "retreat", "force_hard", 1.05, 0.05),
    ],
    ids=["steep", "slow", "in retreat"],
)
def test_a_ramp_trips_before_its_limit_is_reached_by_its_steepness(
    rate, mode, kind, fraction, within, sign
):
    violation, load = ramp(sign * rate, mode)
    assert violation.kind == kind
    assert load == pytest.approx(fraction, abs=within)
    assert ("in 20 ms" in violation.reason) == (mode == "guarded")


def test_noise_well_below_the_limit_does_not_trip():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    random = np.random.default_rng(1)
    for _ in range(1000):
        clock.advance(0.004)
        value = np.array([0, 0, -0.8 * RATING[2], 0, 0, 0])
        value += random.normal(0, 0.002, 6) * RATING
        assert check(guard, clock, value) is None


@pytest.mark.parametrize(
    ("loads", "step", "mode"),
    [
        (np.linspace(-10.0, 0.0, 8), 0.004, "guarded"),
        ((2.0, 4.0, 6.0, 8.0, 9.0), 0.025, "guarded"),
        ((-13.0, -13.0, -13.01, -12.99, -13.0, -12.0, -8.0, -4.0), 0.004, "retreat"),
    ],
    ids=["unloading fast", "samples too far apart", "retreat from above both limits"],
)
def test_loads_that_do_not_trip(loads, step, mode):
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    for load in loads:
        clock.advance(step)
        assert check(guard, clock, (0, 0, load, 0, 0, 0), mode) is None


def test_the_same_sample_seen_again_is_no_slope():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    record = force(clock.now_ns(), (0, 0, 9.0, 0, 0, 0))
    for _ in range(10):
        clock.advance(0.004)
        assert guard.check(clock.now_ns(), record, pose(clock.now_ns())) is None


@pytest.mark.parametrize(
    ("force_age", "pose_age", "kind"),
    [
        (50 * MS, 100 * MS, None),
        (50 * MS + 1, 0, "stale_force"),
        (None, 0, "stale_force"),
        (0, 100 * MS + 1, "stale_pose"),
        (0, None, "stale_pose"),
    ],
)
def test_data_is_stale_just_past_its_limit_and_missing_data_is(force_age, pose_age, kind):
    now_ns = 10_000 * MS
    records = (
        None if age is None else record(now_ns - age)
        for record, age in ((force, force_age), (pose, pose_age))
    )
    violation = Guard(LIMITS, FRAME).check(now_ns, *records)
    assert (violation and violation.kind) == kind


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("face", [0, 1])
def test_each_face_of_the_box_holds(axis, face):
    inside, outside = [0.0, 0.0, 0.01], [0.0, 0.0, 0.01]
    inside[axis] = BOX[face][axis] * (1 - 1e-6)
    outside[axis] = BOX[face][axis] * (1 + 1e-3)
    guard = Guard(LIMITS, FRAME)
    assert check(guard, FakeClock(), place=inside) is None
    for mode in ("guarded", "travel"):
        violation = check(guard, FakeClock(), place=outside, mode=mode)
        assert violation.kind == "box"
        assert f"{'xyz'[axis]} = " in violation.reason
    assert check(guard, FakeClock(), place=outside, mode="retreat") is None


def test_on_a_dome_the_box_is_as_deep_below_the_surface_everywhere():
    domed = dataclasses.replace(LIMITS, dome_radius=0.029)
    x, y = BOX[1][0] / 2, BOX[1][1] / 2
    low = BOX[0][2] + dome_height(0.029, x, y)
    assert low < BOX[0][2] - 0.005
    assert outside_box(domed, FRAME, transform(FRAME, (x, y, low + 1e-6))) is None
    assert "z = " in outside_box(domed, FRAME, transform(FRAME, (x, y, low - 1e-5)))
    assert "z = " in outside_box(domed, FRAME, transform(FRAME, (0.0, 0.0, BOX[0][2] - 1e-5)))


def test_a_target_outside_the_box_says_so_in_millimetres():
    reason = outside_box(LIMITS, FRAME, transform(FRAME, (0.0, 0.0, -0.0012)))
    assert reason is not None
    assert "z = -1.20 mm" in reason
    assert "allowed -1.00 to 100.00 mm" in reason
    assert outside_box(LIMITS, FRAME, (np.nan, 0.0, 0.0)) is not None


def test_retreat_goes_on_without_data_and_with_a_saturated_sensor():
    now_ns = 10_000 * MS
    guard = Guard(LIMITS, FRAME)
    assert guard.check(now_ns, None, None, "retreat") is None
    record = force(now_ns - 1000 * MS, status=0x20000)
    assert guard.check(now_ns, record, pose(now_ns), "retreat") is None


def test_retreat_is_not_held_by_a_sensor_lost_while_its_load_grew():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    for load in (11.0, 12.0, 13.0, 14.0, 15.0):
        clock.advance(0.004)
        newest = force(clock.now_ns(), (0, 0, load, 0, 0, 0))
        violation = guard.check(clock.now_ns(), newest, None, "retreat")
    assert violation.kind == "force_hard"
    clock.advance(0.0501)
    assert guard.check(clock.now_ns(), newest, None, "retreat") is None


def test_only_masked_status_bits_count():
    now_ns = 10_000 * MS
    guard = Guard(LIMITS, FRAME)
    assert guard.check(now_ns, force(now_ns, status=0x10000), pose(now_ns)) is None
    violation = guard.check(now_ns, force(now_ns, status=0x20000), pose(now_ns))
    assert violation.kind == "force_status"


@pytest.mark.parametrize("mode", ["guarded", "travel", "retreat"])
@pytest.mark.parametrize(
    ("bits", "kind"),
    [(0x1, None), (0x3, None), (0x404, "protective_stop"), (0x4C0, "emergency_stop")],
)
def test_safety_stops_count_in_every_mode(mode, bits, kind):
    now_ns = 10_000 * MS
    violation = Guard(LIMITS, FRAME).check(now_ns, force(now_ns), pose(now_ns, safety=bits), mode)
    assert (violation and violation.kind) == kind


@pytest.mark.parametrize("bit", range(11))
def test_every_safety_bit_but_normal_reduced_and_recovery_stops(bit):
    assert (judge_safety(1 << bit) is None) == (bit in (0, 1, 3))


def test_the_most_serious_reason_wins():
    now_ns = 10_000 * MS
    hard, soft = (0, 0, 13.0, 0, 0, 0), (0, 0, 11.0, 0, 0, 0)
    stale = force(now_ns - 1000 * MS, soft)
    assert Guard(LIMITS, FRAME).check(now_ns, stale, pose(now_ns)).kind == "stale_force"
    fresh = force(now_ns, hard)
    assert Guard(LIMITS, FRAME).check(now_ns, fresh, None).kind == "force_hard"
    stopped = pose(now_ns, safety=0x404)
    assert Guard(LIMITS, FRAME).check(now_ns, fresh, stopped).kind == "protective_stop"


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"force_rating": (1.0,) * 5}, "force_rating"),
        ({"force_rating": (0.0,) * 6}, "force_rating"),
        ({"soft_fraction": 1.2}, "soft_fraction"),
        ({"box": (BOX[1], BOX[0])}, "box"),
    ],
)
def test_senseless_limits_are_refused(change, named):
    with pytest.raises(ValueError, match=named):
        GuardLimits(**{"force_rating": RATING, "box": BOX, **change})


@pytest.mark.parametrize("axis", range(6))
def test_nan_stops_on_a_measured_axis_only(axis):
    name = AXES[axis][0]
    value = np.zeros(6)
    value[axis] = np.nan
    found = check(Guard(LIMITS, FRAME), FakeClock(), value)
    assert found is not None
    assert found.kind == "force_status"
    assert name in found.reason
    others = tuple(other for other, _ in AXES if other != name)
    without = dataclasses.replace(LIMITS, axes_measured=others)
    assert check(Guard(without, FRAME), FakeClock(), value) is None


def test_an_axis_that_is_not_measured_hides_no_other():
    """NaN compares as False with everything: it must not reach sums or slopes."""
    limits = dataclasses.replace(LIMITS, axes_measured=("Fx", "Fy", "Fz"))
    violation, load = ramp(-12.5, "guarded", limits, np.nan)
    assert violation.kind == "force_soft"
    assert load <= 0.851


def several(now_ns: int, loads, statuses=None):
    """Return one force record a millisecond, the last at `now_ns`, with the loads along z."""
    statuses = statuses or [0] * len(loads)
    ages = range(len(loads) - 1, -1, -1)
    return np.concatenate(
        [
            force(now_ns - age * MS, (0, 0, load, 0, 0, 0), status)
            for age, load, status in zip(ages, loads, statuses, strict=True)
        ]
    )


@pytest.mark.parametrize("place", range(5))
@pytest.mark.parametrize(
    ("load", "status", "kind"),
    [(-55.0, 0, "force_hard"), (-10.5, 0, "force_soft"), (-1.0, 0x20000, "force_status")],
)
def test_one_bad_record_between_two_looks_stops_wherever_it_is(place, load, status, kind):
    loads, statuses = [-1.0] * 5, [0] * 5
    loads[place], statuses[place] = load, status
    records = several(10_000 * MS, loads, statuses)
    assert ForceGuard(LIMITS).check(10_000 * MS, records, "guarded").kind == kind


def test_a_protective_stop_or_a_place_outside_the_box_between_two_looks_stops():
    now_ns = 10_000 * MS
    outside = pose(now_ns - 4 * MS, place=(0.0, 0.0, -0.002))
    for bad, kind in ((outside, "box"), (pose(now_ns, safety=0x404), "protective_stop")):
        records = np.concatenate([bad, pose(now_ns)])
        assert MotionGuard(LIMITS, FRAME).check(now_ns, records, "guarded").kind == kind


def test_one_impossible_record_is_left_out_and_a_second_one_stops():
    now_ns, guard = 10_000 * MS, ForceGuard(LIMITS)
    for loads, kind in (
        ([-1.0, 2147.0, -1.0, -2147.0, -1.0], None),
        ([-1.0, -1.0, 2147.0], None),
        ([2147.0, -1.0], "force_hard"),
        ([-1.0, 2147.0, 2147.0, -1.0], "force_hard"),
    ):
        now_ns += 5 * MS
        found = guard.check(now_ns, several(now_ns, loads), "guarded")
        assert (found and found.kind) == kind
        if loads[-1] == 2147.0:  # no new record by the next look
            assert guard.check(now_ns + MS, several(now_ns, loads)[-1:], "guarded") is None


@pytest.mark.parametrize(
    ("loads", "holds"),
    [
        ([2147.0], False),
        ([-14.0], False),
        ([-14.0, -14.5], False),
        ([-14.0, -14.0, -14.0], False),
        ([-14.0, -13.0, -15.0], False),
        ([-14.0, -14.5, -15.0], True),
    ],
)
def test_a_retreat_goes_on_unless_the_load_grows_over_three_records(loads, holds):
    guard, now_ns = ForceGuard(LIMITS), 10_000 * MS
    assert guard.check(now_ns, several(now_ns, [-3.0] * 8), "retreat") is None
    later_ns = now_ns + len(loads) * MS
    found = guard.check(later_ns, several(later_ns, loads), "retreat")
    assert (found is not None) == holds


def test_the_slope_takes_every_record_of_a_look():
    """100 N/s from 8 N: the limit of 10.2 N is 20 ms ahead, seen within one look of 12 records."""
    now_ns = 10_000 * MS
    records = several(now_ns, [-8.0 - 0.1 * k for k in range(12)])
    violation = ForceGuard(LIMITS).check(now_ns, records, "guarded")
    assert violation.kind == "force_soft"
    assert "in 20 ms" in violation.reason


def test_a_gauge_among_several_is_named():
    violation = ForceGuard(LIMITS, "left").check(MS, force(MS, (0, 0, 13.0, 0, 0, 0)), "guarded")
    assert violation.reason.startswith("left: Fz: 13 N")
