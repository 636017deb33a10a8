from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from rig.core.clock import FakeClock
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
        reasons = (
            self.force.check(now_ns, forces, mode),
            self.motion.check(now_ns, poses, mode),
        )
        return most_serious(reason for reason in reasons if reason is not None)


def check(guard: Guard, clock: FakeClock, value=(0.0,) * 6, mode="guarded", **place):
    now_ns = clock.now_ns()
    return guard.check(now_ns, force(now_ns, value), pose(now_ns, **place), mode)


def ramp(rate: float, *, axis: int = 2, mode="guarded", steps: int = 400):
    """Apply a force growing at `rate` [N/s], sampled at 4 ms; return load and violation."""
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    for _ in range(steps):
        clock.advance(0.004)
        value = np.zeros(6)
        value[axis] = rate * clock.now_ns() / 1e9
        violation = check(guard, clock, value, mode)
        if violation is not None:
            return abs(value[axis]) / RATING[axis], violation
    return None, None


def test_nothing_wrong_is_no_verdict():
    assert check(Guard(LIMITS, FRAME), FakeClock()) is None


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
    if violation:
        name, unit = AXES[axis]
        assert violation.reason.startswith(f"{name}: ")
        assert unit in violation.reason


def test_a_steep_ramp_trips_before_the_limit_is_reached():
    fraction, violation = ramp(100.0)
    assert violation.kind == "force_soft"
    assert "in 20 ms" in violation.reason
    # 100 N/s for 20 ms is 2 N of 12 N: about a sixth of the rating early.
    assert 0.85 - 2 / 12 - 0.04 < fraction < 0.85 - 2 / 12 + 0.04


def test_a_steep_ramp_the_other_way_trips_early_too():
    fraction, violation = ramp(-100.0)
    assert violation.kind == "force_soft"
    assert fraction < 0.75


def test_a_slow_ramp_trips_at_the_limit():
    fraction, violation = ramp(10.0)
    assert violation.kind == "force_soft"
    assert fraction == pytest.approx(0.85 - 0.2 / 12, abs=0.01)


def test_noise_well_below_the_limit_does_not_trip():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    random = np.random.default_rng(1)
    for _ in range(5000):
        clock.advance(0.004)
        value = np.array([0, 0, -0.8 * RATING[2], 0, 0, 0])
        value += random.normal(0, 0.002, 6) * RATING
        assert check(guard, clock, value) is None


def test_unloading_fast_does_not_trip():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    for load in np.linspace(-10.0, 0.0, 8):
        clock.advance(0.004)
        assert check(guard, clock, (0, 0, load, 0, 0, 0)) is None


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
        (0, 100 * MS + 1, "stale_pose"),
    ],
)
def test_data_is_stale_just_past_its_limit(force_age, pose_age, kind):
    now_ns = 10_000 * MS
    guard = Guard(LIMITS, FRAME)
    violation = guard.check(now_ns, force(now_ns - force_age), pose(now_ns - pose_age))
    assert (violation and violation.kind) == kind


def test_missing_data_is_stale_unless_it_is_not_watched():
    now_ns = 10_000 * MS
    assert Guard(LIMITS, FRAME).check(now_ns, None, pose(now_ns)).kind == "stale_force"
    assert Guard(LIMITS, FRAME).check(now_ns, force(now_ns), None).kind == "stale_pose"
    assert MotionGuard(LIMITS, FRAME).check(now_ns, pose(now_ns), "guarded") is None
    assert ForceGuard(LIMITS).check(now_ns, force(now_ns), "guarded") is None


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


def test_retreat_may_leave_a_load_above_both_limits():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    for load in (13.0, 13.0, 13.01, 12.99, 13.0, 12.0, 8.0, 4.0):
        clock.advance(0.004)
        assert check(guard, clock, (0, 0, -load, 0, 0, 0), "retreat") is None


def test_retreat_stops_while_a_load_above_the_hard_limit_grows():
    fraction, violation = ramp(-100.0, mode="retreat")
    assert violation.kind == "force_hard"
    assert 1.0 < fraction < 1.1


def test_retreat_goes_on_without_data_and_with_a_saturated_sensor():
    now_ns = 10_000 * MS
    guard = Guard(LIMITS, FRAME)
    assert guard.check(now_ns, None, None, "retreat") is None
    record = force(now_ns - 1000 * MS, status=0x20000)
    assert guard.check(now_ns, record, pose(now_ns), "retreat") is None


def test_retreat_is_not_held_by_a_sensor_lost_while_its_load_grew():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    for load in (10.0, 11.0, 12.0, 13.0, 14.0):
        clock.advance(0.004)
        newest = force(clock.now_ns(), (0, 0, load, 0, 0, 0))
        violation = guard.check(clock.now_ns(), newest, None, "retreat")
    assert violation.kind == "force_hard"
    clock.advance(0.0501)
    assert guard.check(clock.now_ns(), newest, None, "retreat") is None


def test_samples_too_far_apart_predict_nothing():
    guard, clock = Guard(LIMITS, FRAME), FakeClock()
    for load in (2.0, 4.0, 6.0, 8.0, 9.0):
        clock.advance(0.025)
        assert check(guard, clock, (0, 0, load, 0, 0, 0)) is None


def test_travel_keeps_the_soft_limit():
    assert check(Guard(LIMITS, FRAME), FakeClock(), (8.6, 0, 0, 0, 0, 0), "travel").kind == (
        "force_soft"
    )


def test_only_masked_status_bits_count():
    now_ns = 10_000 * MS
    guard = Guard(LIMITS, FRAME)
    assert guard.check(now_ns, force(now_ns, status=0x10000), pose(now_ns)) is None
    violation = guard.check(now_ns, force(now_ns, status=0x20000), pose(now_ns))
    assert violation.kind == "force_status"


def test_a_force_that_is_not_a_number_stops():
    violation = check(Guard(LIMITS, FRAME), FakeClock(), (np.nan, 0, 0, 0, 0, 0))
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


def test_combined_loads_count_only_when_asked():
    value = (0, 0, 0.7 * RATING[2], 0.5 * RATING[3], 0, 0)
    assert check(Guard(LIMITS, FRAME), FakeClock(), value) is None
    limits = GuardLimits(force_rating=RATING, box=BOX, combined_fraction=1.05)
    violation = check(Guard(limits, FRAME), FakeClock(), value)
    assert violation.kind == "force_hard"
    assert "Fz and Txy together" in violation.reason


@pytest.mark.parametrize(
    ("fractions", "name"),
    [
        ((0.24, 0.32, 0, 0, 0, 0.2), "Fxy and Tz together"),  # hypot 0.4, and 0.2
        ((0, 0, 0.2, 0.32, 0.24, 0), "Fz and Txy together"),
    ],
)
def test_combined_loads_are_sums_of_fractions_over_their_limit(fractions, name):
    value = [fraction * most for fraction, most in zip(fractions, RATING, strict=True)]
    stop = GuardLimits(force_rating=RATING, box=BOX, combined_fraction=0.59)
    violation = check(Guard(stop, FRAME), FakeClock(), value)
    assert violation.kind == "force_hard"
    assert f"{name}: 60% of their ratings" in violation.reason
    end = GuardLimits(force_rating=RATING, box=BOX, combined_fraction=0.69)
    assert check(Guard(end, FRAME), FakeClock(), value).kind == "force_soft"
    allow = GuardLimits(force_rating=RATING, box=BOX, combined_fraction=0.72)
    assert check(Guard(allow, FRAME), FakeClock(), value) is None


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


@pytest.mark.parametrize("combined", [None, 1.05])
def test_an_axis_that_is_not_measured_hides_no_other(combined):
    """NaN compares as False with everything: it must not reach sums or slopes."""
    limits = dataclasses.replace(
        LIMITS, axes_measured=("Fx", "Fy", "Fz"), combined_fraction=combined
    )
    guard, clock = Guard(limits, FRAME), FakeClock()
    for step in range(400):
        clock.advance(0.004)
        force_z = -0.05 * step
        violation = check(guard, clock, (0.0, 0.0, force_z, *[np.nan] * 3))
        if violation is not None:
            break
    assert violation is not None
    assert violation.kind == "force_soft"
    assert abs(force_z) <= 0.851 * RATING[2]


@pytest.mark.parametrize("axes", [(), ("Fq",)])
def test_axes_that_are_none_are_refused(axes):
    with pytest.raises(ValueError, match="axes_measured"):
        dataclasses.replace(LIMITS, axes_measured=axes)


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
@pytest.mark.parametrize(("load", "kind"), [(2147.0, "force_hard"), (-10.5, "force_soft")])
def test_one_bad_record_between_two_looks_stops_wherever_it_is(place, load, kind):
    loads = [-1.0] * 5
    loads[place] = load
    violation = ForceGuard(LIMITS).check(10_000 * MS, several(10_000 * MS, loads), "guarded")
    assert violation.kind == kind


def test_a_status_between_two_looks_stops():
    records = several(10_000 * MS, [-1.0] * 3, [0, 0x20000, 0])
    violation = ForceGuard(LIMITS).check(10_000 * MS, records, "guarded")
    assert violation.kind == "force_status"


def test_a_protective_stop_or_a_place_outside_the_box_between_two_looks_stops():
    now_ns = 10_000 * MS
    outside = pose(now_ns - 4 * MS, place=(0.0, 0.0, -0.002))
    for bad, kind in ((outside, "box"), (pose(now_ns, safety=0x404), "protective_stop")):
        records = np.concatenate([bad, pose(now_ns)])
        assert MotionGuard(LIMITS, FRAME).check(now_ns, records, "guarded").kind == kind


def test_one_bad_record_does_not_hold_a_retreat_in_contact():
    guard, now_ns = ForceGuard(LIMITS), 10_000 * MS
    assert guard.check(now_ns, several(now_ns, [-3.0] * 8), "retreat") is None
    later_ns = now_ns + 4 * MS
    assert guard.check(later_ns, several(later_ns, [-3.0, -3.0, 2147.0]), "retreat") is None


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
