"""Witnesses of recordings that cannot be true: each a function that healthy data leave quiet.

A witness compares one quantity with another that it cannot contradict: a force with the depth, the
place of the tip with its plan, a torque with the lever of its force. It says how near its threshold
it came, 1 at the threshold, so that the margin of healthy sessions is known. Without the
other quantity it says nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from recorder.checks.directions import ASIDE_WAY, follows
from recorder.checks.pictures import pictures, taxels
from recorder.checks.testimony import Testimony, worst
from recorder.checks.timing import SEVERAL, force_timing
from recorder.findings import Finding
from recorder.session.align import NS, changed, largest, quaternion, untrusted_words
from recorder.session.columns import StreamPart, blocks
from recorder.session.presses import ASIDE, BACK, DEEP, DOWN, NOISE, PRESSED, Presses
from recorder.session.reader import Session
from recorder.session.states import READING
from recorder.spec import AXES

Floats = NDArray[np.float64]
Witness = Callable[[Presses], Iterator[Testimony]]


def statements(
    session: Session, *, images: bool = True, looked: dict[str, Any] | None = None
) -> Iterator[Testimony]:
    """Yield the testimonies of all witnesses, doubtful or not; without `images` none is decoded.

    `looked`, given again with a session that has grown, keeps what its pictures showed.
    """
    presses = Presses(session, looked)
    for witness in (*OF_GAUGE, *OF_ALL, *[pictures] * images):
        with np.errstate(all="ignore"):
            yield from witness(presses)


def doubts(session: Session, *, notes: bool = False, **others: Any) -> Iterator[Finding]:
    """Yield the warnings of a session, and faults of pictures that no reader decodes.

    `notes` name also what the session does not show; `others` are those of `statements`.
    """
    for one in statements(session, **others):
        if one.doubtful or (notes and one.finding.level == "note"):
            yield one.finding


# The gauge.

# Time away from all presses after which a skin has recovered [s], part of it that is looked at at
# once, and height of the tip [m]; and that on the way down to a press.
RECOVERED, CLEAR_PART, CLEAR_HEIGHT, CLEAR_DOWN = 1.5, 0.25, 1e-3, 0.1e-3
# Force without contact [N], and over the largest in a press.
CLEAR_LEAST, CLEAR_OF_PEAK = 0.3, 0.05
# Largest factor of a force beside the expected interval.
SCALE = 3.0
# Change of the force of a control press, over it, and the least one [N]. Time from arrival at the
# depth in which a press's force counts [s]: a skin that is held relaxes.
CHANGED, CHANGED_LEAST, ARRIVED = 0.05, 0.05, 0.06
# Known factors between units, by the one that was taken for a newton.
UNITS = {
    "mN (1000)": 1e3,
    "kN (0.001)": 1e-3,
    "pounds (0.225 to the newton)": 1 / 4.448,
    "kilograms (0.102 to the newton)": 1 / 9.807,
    "newtons that were converted from pounds (4.45)": 4.448,
    "newtons that were converted from kilograms (9.81)": 9.807,
}
# Largest angle between side forces and the shear [deg], as rig has the gauge's axes along those of
# the contact, and in less than `SEVERAL` shears, which do not average out a contact's own shape;
# factor between the two axes, as friction has no direction, but an indenter's shape has; and the
# way along an axis over that of all shears from which it shows.
ASTRAY, ASTRAY_FEW, UNEVEN, ALONG = 25.0, 50.0, 2.5, 0.3
# Step of a force from one sample to the next [N], over that of a press, over the noise, and over
# the steps before and after it; and the least rate at which no press is that fast [Hz].
STEP, STEP_OF_PEAK, STEPPED, STEP_RATE = 0.85, 0.1, 3.0, 200.0
# Equal samples of a gauge, [s] and over the runs of equal ones, of which one in a thousand is
# longer.
HELD, HELD_USUAL = 0.2, 5.0
# Force that is compared with others of its depth, and its lever with torques [N]; error of torque
# that is none over its size; error that the contact's own place may add [m], and its effect if
# the tip's is known; longest lever [m].
LOADED, TWIST, PLACE, SPOT, LEVER = 0.2, 0.3, 4e-3, 1e-3, 0.6


def _where(presses: Presses) -> str:
    return f"streams/{presses.force.name if presses.force else 'force'}/value"


def impossible(presses: Presses) -> Iterator[Testimony]:
    """Values that no gauge of this rating sends."""
    if presses.force is None or not len(presses.force) or not presses.measured:
        return
    limit = largest(presses.force)
    axes, worst = list(presses.measured), (-1.0, 0, 0)
    for part in blocks(len(presses.force)):
        values = presses.values(part.start, part.stop)[:, axes]
        sizes = np.nan_to_num(np.abs(values) / limit[axes])
        row, k = divmod(int(sizes.argmax()), len(axes))
        worst = max(worst, (float(sizes[row, k]), part.start + row, axes[k]), key=itemgetter(0))
    doubt, row, column = worst
    unit, value = "N" if column < 3 else "N m", presses.values(row, row + 1)[0, column]
    sends = f"a gauge sends less than {limit[column]:.4g} {unit}: check the unit, or the device"
    message = f"{AXES[column]} is {value:.4g} {unit} in row {row}, {sends}"
    yield Testimony(doubt, Finding("impossible", _where(presses), message))


def marked(presses: Presses) -> Iterator[Testimony]:
    """Samples that the device marks as untrusted."""
    for stream in presses.session.streams.values():
        if untrusted_words(StreamPart(stream, 0, 0)) is None:
            continue
        count, row, word = 0, 0, 0
        for part in blocks(len(stream)):
            words = untrusted_words(StreamPart(stream, part.start, part.stop))
            bad = np.flatnonzero(np.asarray(words))
            if words is not None and bad.size and not count:
                row, word = part.start + int(bad[0]), int(words[bad[0]])
            count += bad.size
        message = f"the device marks {count} samples as invalid, first row {row} (0x{word:x})"
        finding = Finding("untrusted", f"streams/{stream.name}/status", message)
        yield Testimony(2.0 * bool(count), finding)


def _peak(presses: Presses) -> float:
    """Return the median over presses of the largest force [N]."""
    axes = presses.forces
    sizes = [np.abs(one.wrench[:, axes]) for one in presses.of(DOWN)]
    tops = [float(size.max()) for size in sizes if size.size and np.isfinite(size).all()]
    return float(np.median(tops)) if tops else 0.0


def clear_force(presses: Presses) -> Iterator[Testimony]:
    """Force while nothing is touched, beside that point's own reference."""
    session, force = presses.session, presses.force
    if not presses.forces or not len(session.segments["target"]) or force is None:
        return
    segments = session.segments
    found = []
    allowed = max(CLEAR_LEAST, CLEAR_OF_PEAK * _peak(presses))
    limits = np.maximum(allowed, NOISE * presses.sigma[:3])

    def felt(level: Floats, row: int) -> None:
        axis = max(presses.forces, key=lambda k: abs(level[k]) / limits[k])
        text = f"{AXES[axis]} is {level[axis]:+.3g} N without contact, from row {row}; allowed: "
        text += f"{limits[axis]:.2g} N beside the reference: tare again, look for a slipped cable"
        found.append((float(abs(level[axis]) / limits[axis]), text))

    for one in presses.of(DOWN):
        if (above := one.depth < -CLEAR_DOWN).sum() >= NOISE:
            felt(np.median(one.wrench[above], axis=0), one.first)
    part = round(CLEAR_PART / NS)
    for run in range(max(len(session.runs), 1)):
        rows, (moments, places) = session.rows_of_run(force.name, run), presses.places(run)
        times, of_run = force.t_ns[rows], np.flatnonzero(np.asarray(segments["run"]) == run)
        if not of_run.size or len(times) < 2:
            continue
        order = of_run[np.argsort(np.asarray(segments["start_ns"])[of_run])]
        starts, ends = (np.asarray(segments[name])[order] for name in ("start_ns", "end_ns"))
        parts = times[0] + part * np.unique((times - times[0]) // part)
        begun = np.searchsorted(starts, parts + part)
        free = begun == np.searchsorted(ends + round(RECOVERED / NS), parts, side="right")
        for at, number in zip(parts[free].tolist(), begun[free].tolist(), strict=True):
            low, high = np.searchsorted(times, (at, at + part))
            near = places[slice(*np.searchsorted(moments, (at, at + part)))]
            if high - low >= 3 and len(near) and near[:, 2].min() > CLEAR_HEIGHT:
                target = int(segments["target"][order[min(number, len(order) - 1)]])
                values = presses.values(*(int(k) + (rows.start or 0) for k in (low, high)))
                level = np.median(values, axis=0) - presses.offset(run, target, at)
                felt(level, int(low) + (rows.start or 0))
    yield from worst(found, "clear-force", _where(presses))


def pulls(presses: Presses) -> Iterator[Testimony]:
    """Fz above 0 while the skin is pressed: its sign is wrong, or the axis is another."""
    if 2 not in presses.measured:
        return
    found = []
    for one in presses.of(DOWN, ASIDE, BACK):
        deep = one.depth > PRESSED * presses.planned("depth", one.target)
        if deep.sum() >= 3:
            force = float(np.median(one.wrench[deep, 2]))
            pressed = f"while target {one.target + 1} is pressed, from row {one.first}"
            text = f"Fz is {force:+.3g} N {pressed}; compression is negative: check axis and sign"
            found.append((force / presses.felt(2), text))
    yield from worst(found, "wrong-sign", _where(presses))


def scale(presses: Presses) -> Iterator[Testimony]:
    """Forces of another size than those expected of the skin, or than other presses have."""
    expected = presses.session.setting("expected_force")
    depths, forces = (np.asarray(expected.get(name) or [], float) for name in ("depths", "forces"))
    doubt, factors = [], []
    for depth, force, _target in _deepest(presses):
        near = np.abs(depths - depth) < 1e-5 + 0.02 * depth if depths.size else np.zeros(0, bool)
        if near.any() and np.isfinite(forces[near][0]).all() and forces[near][0][0] > 0:
            low, high = forces[near][0]
            factor = max(force, 1e-9) / np.clip(force, low, high)
            doubt.append(float(max(factor, 1 / factor) / SCALE))
            factors.append(max(force, 1e-9) / np.sqrt(low * high))
    if doubt:
        size = float(np.median(factors))
        unit = min(UNITS, key=lambda name: abs(np.log(size / UNITS[name])))
        like = f", as if they were {unit}" if abs(np.log(size / UNITS[unit])) < 0.35 else ""
        text = f"forces are {size:.3g} times those expected of this skin (median){like}"
        finding = Finding("scale", _where(presses), f"{text}: check unit, skin and indenter")
        yield Testimony(float(np.median(doubt)), finding)


def control(presses: Presses) -> Iterator[Testimony]:
    """Control presses with another force than any press of their place and depth."""
    controls, point = presses.session.controls, presses.session.targets.get("point", ())
    tops = [(depth, point[target], force, target) for depth, force, target in _deepest(presses)]
    found = []
    for *place, force, target in tops:
        alike = [usual for *at, usual, of in tops if at == place and of not in controls]
        if target in controls and alike:
            low, high = min(alike), max(alike)
            # A skin relaxes from press to press; how much is known of several.
            part = CHANGED if len(alike) >= 3 else 2 * CHANGED
            limit = max(part * high, CHANGED_LEAST, NOISE * float(presses.sigma[2]))
            text = f"the control press takes {force:.3g} N, others of its place and depth "
            text += f"{low:.3g} to {high:.3g} N: slipped mount, torn skin, or drift"
            found.append((abs(force - min(max(force, low), high)) / limit, text))
    yield from worst(found, "control", _where(presses))


def _deepest(presses: Presses) -> list[tuple[float, float, int]]:
    """Return planned depth [m], compression at it [N] and target of the whole presses."""
    found: list[tuple[float, float, int]] = []
    if (force := presses.force) is None or 2 not in presses.measured:
        return found
    for one in presses.of(DOWN):
        depth = presses.planned("depth", one.target)
        at = np.flatnonzero(one.depth > 0.95 * depth)[: round(ARRIVED * force.rate_hz)]
        if one.whole and depth >= DEEP and len(at) >= 3:
            found.append((depth, float(-np.median(one.wrench[at, 2])), one.target))
    return found


def steps(presses: Presses) -> Iterator[Testimony]:
    """Forces that are other ones from one sample to the next, and stay so."""
    if presses.force is None or not presses.forces or presses.force.rate_hz < STEP_RATE:
        return
    axes, worst = presses.forces, (0.0, 0, 0)
    limit = max(STEP, STEP_OF_PEAK * _peak(presses)) + NOISE * presses.sigma[axes]
    for part in blocks(len(presses.force) - 3):
        step = np.abs(np.diff(presses.values(part.start, part.stop + 3)[:, axes], axis=0))
        sizes = step[1:-1] / (limit + STEPPED * np.maximum(step[:-2], step[2:]))
        row, k = divmod(int(np.nan_to_num(sizes).argmax()), len(axes))
        worst = max(worst, (float(np.nan_to_num(sizes[row, k])), part.start + row + 1, axes[k]))
    doubt, row, axis = worst
    before, after = presses.values(row, row + 2)[:, axis] if doubt else (0.0, 0.0)
    message = f"{AXES[axis]} is {before:.3g} N in row {row} and {after:.3g} N in the next"
    yield Testimony(doubt, Finding("force-step", _where(presses), message))


def held(presses: Presses) -> Iterator[Testimony]:
    """Gauges and taxels with noise that send the same values again and again."""
    for stream in presses.session.streams.values():
        if stream.traits.kind not in ("force", "taxels") or len(stream) < 100:
            continue
        differs = changed(stream, stream.rows("value", slice(None)))
        if differs.mean() < 0.5 or READING in stream.names:
            continue  # one without noise, or a scale that settles
        runs = np.diff(np.flatnonzero(differs))
        usual = float(np.quantile(runs, 0.999, method="lower"))
        worst = int(runs.argmax())
        same = f"the same values in {runs[worst]} rows, from row {int(runs[:worst].sum())}"
        message = f"{same}, though others differ from row to row: frozen"
        doubt = float(runs[worst]) / max(HELD * stream.rate_hz, HELD_USUAL * usual)
        yield Testimony(doubt, Finding("held", f"streams/{stream.name}/value", message))


def shear_follows(presses: Presses) -> Iterator[Testimony]:
    """Side forces that are mirrored, do not follow the shear, or are larger along one axis."""
    shears, least, where = [], presses.felt(0, 1), _where(presses)
    if presses.force is None or not {0, 1} <= set(presses.measured):
        return
    for one in presses.of(ASIDE):
        if one.whole and abs(one.way) > ASIDE_WAY:
            force = one.wrench[-3:].mean(axis=0) - one.wrench[:3].mean(axis=0)
            # Friction follows the normal force.
            normal = np.fmax(abs(one.wrench[-3:, 2].mean()), least)
            shears.append((one.way / abs(one.way), complex(*force[:2]), normal))
    way, force, normal = np.array(shears or np.zeros((0, 3))).T
    felt = np.abs(force) > least
    if not felt.any():
        message = "side axes and torques not verified: no shear shows them"
        yield Testimony(0.0, Finding("unverified", where, message))
        return
    astray = ASTRAY if felt.sum() >= SEVERAL else ASTRAY_FEW
    doubt, how = follows(way[felt], force[felt] / np.abs(force[felt]), astray)
    message = f"side forces in {felt.sum()} shears are, beside the tip's way, {how}"
    yield Testimony(doubt, Finding("shear-direction", where, message))
    along = np.array([(way.real**2).sum(), (way.imag**2).sum()])
    if along.min() > ALONG * len(way):
        over = force / normal
        gain = np.abs([way.real @ over.real, way.imag @ over.imag]) / along + 1e-3
        message = f"a shear along x has {gain[0] / gain[1]:.3g} times the side force of one along y"
        doubt = abs(float(np.log(gain[0] / gain[1]) / np.log(UNEVEN)))
        yield Testimony(doubt, Finding("shear-direction", where, message))


def levers(presses: Presses) -> Iterator[Testimony]:
    """Torques that are not those of the force at the tip, or at no place if that is unknown."""
    if len(presses.measured) < len(AXES):
        return
    gauge = presses.session.setting("expected").get("gauge")
    by_target: dict[int, list[Floats]] = {}
    for one in presses.of(DOWN, ASIDE, BACK):
        some = np.hstack([one.wrench, one.tip - gauge if gauge else np.zeros((one.count, 3))])
        square = np.square(some)  # infinite if too large for a number
        some = some[np.isfinite(square).all(axis=1) & (square[:, :3].sum(axis=1) > LOADED**2)]
        by_target.setdefault(one.target, []).append(some[:: max(1, len(some) // 50)].copy())
    found, noise = [], NOISE * presses.sigma.reshape(2, 3).max(axis=1)
    for target, parts in by_target.items():
        force, torque, tip = np.split(np.concatenate(parts), (3, 6), axis=1)
        if len(tip) >= 10 and _size(torque).max() > 2 * noise[1]:
            doubt, how = _lever(force, torque, tip, noise)
            found.append((doubt, f"target {target + 1} has torques {how}"))
    yield from worst(found, "torque", _where(presses))


def _lever(force: Floats, torque: Floats, tip: Floats, noise: Floats) -> tuple[float, str]:
    """Return how doubtful torques of forces at the tip (n, 3) are, and why; 0: an unknown place.

    The contact is beside a known one, at its height above the gauge unless torques of side forces
    tell another. `noise` (2,) is that of forces and torques.
    """
    matrix = np.zeros((len(force), 3, 3))  # of r x F, with r unknown
    for row, (a, b) in enumerate(((1, 2), (2, 0), (0, 1))):
        matrix[:, row, a], matrix[:, row, b] = force[:, b], -force[:, a]
    pushed, height, known = np.linalg.norm(_size(force)), float(tip[:, 2].mean()), bool(tip.any())
    # Noise of side forces, which lever and rest share, shows no other lever up to 3 of its sigma.
    least = SPOT * pushed / max(height, SPOT) + 3 / NOISE * noise[0]
    usual = [0.0, 0.0, known * len(tip) ** 0.5 * least]
    beside = torque - np.cross(tip, force)
    lever = np.linalg.lstsq(
        np.vstack([matrix.reshape(-1, 3), usual]), np.append(beside, 0.0), rcond=1e-3
    )[0]
    left = _size(beside - matrix @ lever)
    away, higher = np.linalg.norm(lever[: 3 - known]), 1 + known * lever[2] / max(height, SPOT)
    spot = (SPOT if known else PLACE) * pushed + noise @ ((height, height, 0.0), (1.0, 1.0, 1.0))
    twisted = left / (TWIST * _size(torque) + spot)
    log = abs(np.log(max(higher, 1e-3)))
    doubts = {
        "that its force has at no place": twisted.max(),
        f"of a force {1e3 * away:.3g} mm away": away / (PLACE if known else LEVER),
        f"of a force at {higher:.3g} times the height of the tip": log / np.log(UNEVEN),
    }
    how, doubt = max(doubts.items(), key=itemgetter(1))
    return float(doubt), f"{how}: check axes, signs and unit"


def _size(vectors: Floats) -> Floats:
    """Return the root of the mean square of each component (3,) of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.square(vectors).mean(axis=0)))


# The arm.

# Largest speed over the planned one; without a plan [m/s]; turning [rad/s]; over this time [s].
FASTER, FAST, TURNING, OVER = 4.0, 2.0, 6.0, 0.1
# Largest distance of an arm from its base [m], turn of a pose [rad], and jump to the next one [m]
# beside 3 times the planned speed, or one that a tenth of its steps exceeds; it moves above [m/s].
REACH, TURN, JUMP, JUMPY, MOVING = 4.0, 7.0, 0.25e-3, 3.0, 1e-3
# Distance of the reached place from the planned one [m], and over the way to it.
AWAY, AWAY_OF_WAY = 0.3e-3, 0.05
# Largest turn of the tool beside the planned one, which arms repeat to a tenth of it [rad].
ASKEW = np.radians(2.0)
# Time at the end of a phase over which its place is the median, as reported positions jitter [s].
ENDING = 0.03
# Way that a phase plans at least, and the part of it that a frozen pose does not go [m].
WAY, STANDS = 0.2e-3, 0.2


def speeds(presses: Presses) -> Iterator[Testimony]:
    """Poses that move or turn faster than an arm, or lie where none reaches."""
    pose, session = presses.pose, presses.session
    if pose is None:
        return
    arm = presses.session.setting("bench", "arm")
    speeds = (arm.get("speed_mm_s"), arm.get("travel_speed_mm_s"))
    planned = [1e-3 * each for each in speeds if isinstance(each, int | float)]
    limit = max(FASTER * max(planned), 0.05) if planned else FAST
    travel = max(planned, default=0.0)
    found = []
    for run in range(max(len(session.runs), 1)):
        rows = session.rows_of_run(pose.name, run)
        poses = np.asarray(pose.array("value"), np.float64)[rows]
        seconds = pose.t_ns[rows] * NS
        if "device_t" in pose.small:
            device = np.asarray(pose.array("device_t"), np.float64)[rows]
            seconds = device if np.isfinite(device).all() else seconds
        apart = max(1, round(OVER * pose.rate_hz))
        if len(poses) <= apart:
            continue
        step = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1)
        took = np.maximum(np.diff(seconds), 1 / pose.rate_hz)
        moving = (step / took)[step > MOVING * took]
        usual = float(np.quantile(moving, 0.9)) if len(moving) > 2 else 0.0
        lasts = np.maximum(seconds[apart:] - seconds[:-apart], OVER / 2)
        way = np.linalg.norm(poses[apart:, :3] - poses[:-apart, :3], axis=1)
        turns = quaternion(poses[:, 3:])
        twist = _angle(turns[1:], turns[:-1]) - TURNING * took
        for sizes, allowed, unit in (
            (np.linalg.norm(poses[:, :3], axis=1), REACH, "m from the base: mm for m?"),
            (np.linalg.norm(poses[:, 3:], axis=1), TURN, "rad of turn: degrees?"),
            (step - JUMPY * max(usual, travel) * took, JUMP, "m of a jump"),
            (twist, ASKEW, "rad of a jump"),
            (way / lasts, limit, f"m/s, allowed {limit:.3g} m/s"),
            (_angle(turns[apart:], turns[:-apart]) / lasts, TURNING, f"rad/s, allowed {TURNING:g}"),
        ):
            at = int(sizes.argmax())
            row = (rows.start or 0) + at + (len(sizes) == len(step))
            text = f"{sizes[at]:.3g} {unit}, row {row}: check units, and the times of the poses"
            found.append((float(sizes[at]) / allowed, text))
    yield from worst(found, "pose-speed", f"streams/{pose.name}/value")


def _angle(turns: Floats, others: Floats) -> Floats:
    """Return the angles (n,) between rotations, as unit quaternions (n, 4) [rad]."""
    return np.asarray(2 * np.arccos(np.minimum(np.abs((turns * others).sum(axis=1)), 1.0)))


def places(presses: Presses) -> Iterator[Testimony]:
    """Presses that end away from their planned place, or poses that stand while the tip moves."""
    if presses.pose is None:
        return
    found, ending = [], max(1, round(ENDING * presses.pose.rate_hz))
    tool = presses.session.setting("expected").get("tool")
    last = {
        one.target: one for one in presses.phases if one.code in (DOWN, ASIDE) and len(one.place)
    }
    for one in presses.phases:
        if len(one.place) < 3 or not one.whole or one.code not in (DOWN, ASIDE):
            continue
        if tool:
            rows = presses.rows(presses.pose, one.run, one.start, one.end)
            turns = quaternion(presses.pose.array("value")[rows.start : rows.stop, 3:])
            askew = float(_angle(turns, quaternion(np.array(tool))).max())
            found.append((askew / ASKEW, one, f"the tool is turned by {np.degrees(askew):.3g} deg"))
        goal, way = presses.planned_place(one.target), one.place[-1] - one.place[0]
        depth = presses.planned("depth", one.target)
        if one.code == DOWN and depth > WAY:
            gone = float(-way[2])
            text = f"the pose goes {1e3 * gone:.3g} mm down, of {1e3 * depth:.3g} mm and more"
            found.append((STANDS * depth / max(gone, 1e-9), one, text))
        sheared = presses.planned("direction", one.target) >= 0
        if one is last[one.target] and np.isfinite(goal).all() and (one.code == ASIDE) == sheared:
            away = float(np.linalg.norm(np.median(one.place[-ending:], axis=0) - goal))
            allowed = AWAY + AWAY_OF_WAY * float(np.linalg.norm(way))
            text = f"the pose ends {1e3 * away:.3g} mm from the planned place"
            found.append((away / allowed, one, text))
    cure = "check the contact frame and the poses"
    told = [(doubt, f"target {one.target + 1}: {text}: {cure}") for doubt, one, text in found]
    yield from worst(told, "pose-place", f"streams/{presses.pose.name}/value")


OF_GAUGE: tuple[Witness, ...] = (
    impossible,
    clear_force,
    pulls,
    scale,
    steps,
    shear_follows,
    levers,
)
OF_ALL: tuple[Witness, ...] = (marked, held, speeds, places, force_timing, taxels, control)
