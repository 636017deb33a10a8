"""Simulated grips by force: objects of unknown weight and friction are lifted by two fingers.

A hand with a 2F-85 and two GelSights stands over an object on a table, in simulated time. The
fingers feel by models on rendered pictures (`tactile.grasp_model`), or by the World's truth. The
hand rises while `ForceGrip` calls its grip firm, and sets an object down that it refuses.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from learning.force.tactile_model import load
from recorder.processes import cores, results, several
from recorder.progress import ItemProgress
from rig.acquire.grip_force import CLOSED, ForceGrip, GripSettings, Senses, State
from rig.bench.pair import FINGERS, GraspObject, PairSpec
from rig.core.finger import FingerForce, Triple
from rig.devices.gripper.robotiq_emulator import Fingers
from rig.devices.gripper.robotiq_wire import GripperCommand
from rig.mock.world.pair import GRAVITY, PairState, PairWorld
from rig.mock.world.sensors import ladder_of, row_of
from rig.monitor.forces_page import finger_force
from tactile.grasp_model import SENSOR, cached_model

# Faces of the objects, which the model of the fingers has not learned; friction of the skin's row.
FACES, SKIN = ("cylinder", "hexagon", "moon", "pacman"), 0.5
# Ranges of width [m], mass [kg], evenly by its logarithm, and friction.
WIDTHS, MASSES, FRICTIONS = (0.02, 0.06), (0.03, 0.3), (0.25, 0.75)
# Way of the fingers of a 2F-85 by one count [m].
COUNT = 85e-3 / CLOSED
# Interval of simulation and Modbus, and of the cameras; latency of a camera with its model [ns].
STEP_NS, FRAME_NS, LATENCY_NS = 8_000_000, 32_000_000, 24_000_000
# Time of a first grip before it is lifted, and of one at the top; longest lift [ns].
SETTLE_NS, HOLD_NS, LONGEST_NS = 200_000_000, 300_000_000, 8_000_000_000
# Height over which a table gives its load to a rising hand, its way in a step, and its top [m].
SAG, RISE, TOP = 0.3e-3, 40e-6, 4e-3
# Slip that is to be noticed [m] and in this time [s]; slip below which a notice is false [m].
SLIP, SOON, STILL = 50e-6, 0.05, 5e-6
# Frames without contact after which pictures differ by noise alone; slips that a grip acts on.
IDLE, SLIPPING = 8, ("gross", "incipient")

Pair = tuple[FingerForce, FingerForce]
Feel = Callable[[PairWorld, PairState], Pair]


@dataclass(frozen=True, slots=True)
class Load:
    """An object, and the true normal forces [N] that it needs and allows."""

    object: GraspObject
    least: float
    """Force by which friction bears its weight."""
    most: float
    """Force at the limit of counts, if the last count before the touch was just too little."""
    beyond: float
    """Force one count later, before the skins relax, which no grip exceeds."""
    count: float
    """Change by one count of the gripper, at the least force."""

    @property
    def kind(self) -> str:
        """`allowed` or `forbidden` by friction; `limit` where the place of a count decides."""
        if self.least <= self.most:
            return "allowed"
        return "forbidden" if self.least > self.beyond else "limit"

    @property
    def is_fine(self) -> bool:
        """True if one count changes the force by less than half of the least one."""
        return self.count < 0.5 * self.least


def drawn_loads(seed: int, number: int) -> list[Load]:
    """Return the objects of a seed."""
    random, bend = np.random.default_rng(seed), PairSpec(SENSOR, SENSOR).compliance
    viscosity = row_of(SENSOR).effects.viscosity
    fresh = 1.0 + sum(viscosity.ratios if viscosity else ())
    ladders, loads = {face: ladder_of(SENSOR, face) for face in FACES}, []
    for name in map(str, range(number)):
        faces = (str(random.choice(FACES)), str(random.choice(FACES)))
        friction, width = random.uniform(*FRICTIONS), random.uniform(*WIDTHS)
        mass = math.exp(random.uniform(*np.log(MASSES)))

        def counts(force: float, faces: Sequence[str] = faces) -> float:
            depths = sum(ladders[face].deepest(force) for face in faces)
            return (depths + 2 * bend * force) / COUNT

        travel, least = GripSettings().travel, mass * GRAVITY / (2 * friction)
        forces = np.linspace(0.0, 50.0, 2001)
        ways = [counts(float(force)) for force in forces]
        most, beyond = (float(np.interp(at, ways, forces)) for at in (travel, travel + 1))
        count = 0.04 * least / (counts(1.02 * least) - counts(0.98 * least))
        one = GraspObject(name, faces, width, mass, friction / SKIN)
        loads.append(Load(one, least, most, fresh * beyond, count))
    return loads


@dataclass(slots=True)
class Lift:
    """Outcome of one lift."""

    load: Load
    state: State = State.CLOSING
    reason: str = ""
    lifted: bool = False
    """True if the object was borne at the top and not dropped."""
    force: float = math.nan
    """True normal force at the end [N]."""
    noticed: list[float] = field(default_factory=list)
    """Time from a true slip of `SLIP` to its notice, less the latency [s]; infinite: never."""
    false_alarms: int = 0
    seconds: float = 0.0
    """Simulated time [s]."""
    _since_ns: int = -1
    _from: float = 0.0

    def slid(self, t_ns: int, way: float, notice: bool | None = None) -> None:
        """Take the true way that a face slid [m]; True: a finger notices it; False: the end."""
        if self._since_ns < 0 and way > self._from + SLIP:
            self._since_ns = t_ns
        if notice is None:
            return
        if self._since_ns >= 0:
            late = 1e-9 * (t_ns - LATENCY_NS - self._since_ns)
            self.noticed.append(max(late, 0.0) if notice else math.inf)
        elif notice:
            self.false_alarms += way < self._from + STILL
        self._from, self._since_ns = way, -1


class Now:
    """Simulated clock."""

    t_ns = 0

    def now_ns(self) -> int:
        """Return the simulated time."""
        return self.t_ns

    def sleep_until(self, deadline_ns: int) -> None:
        """Go to that time."""
        self.t_ns = max(self.t_ns, deadline_ns)


def truth(*, slips: bool = True) -> Feel:
    """Return true forces of the fingers, with true slips or without any."""
    before = [0.0]

    def feel(_: PairWorld, state: PairState) -> Pair:
        slid = float(state.slip.max())
        slipping, before[0] = slips and slid > before[0] + STILL, slid
        left, right = (_triple(wrench[:3]) for wrench in state.wrench)
        one = FingerForce(FINGERS[0], state.t_ns, left, (1.0, 1.0, 1.0), False, slipping)
        return one, replace(one, finger=FINGERS[1], force=right)

    return feel


class Eyes:
    """Forces of both fingers from their rendered pictures, by a model in a folder."""

    def __init__(self, world: PairWorld, folder: str) -> None:
        self._models = [load(folder).stream() for _ in FINGERS]
        world.place(None)
        for side, model in enumerate(self._models):
            model.begin(np.stack([world.reading(side) for _ in range(10)]))

    def begin(self) -> Eyes:
        """Expect open fingers next."""
        self._idle, self._last = 0, list[Any]()
        for model in self._models:
            model.press(np.zeros(0))
        return self

    def __call__(self, world: PairWorld, state: PairState) -> Pair:
        """Return the forces that the pictures of a state show."""
        self._idle = 0 if (state.depth > 0).any() else self._idle + 1
        if self._idle <= IDLE:
            self.pictures = [world.reading(side) for side in range(len(FINGERS))]
            """Newest picture of each finger (480, 640, 3)."""
            both = zip(self._models, self.pictures, strict=True)
            self._last = [model.step(picture, state.t_ns) for model, picture in both]
        # A grip acts already if the rim of a contact slips.
        left, right = (
            replace(finger_force(name, state.t_ns, one), slipping=one.slip in SLIPPING)
            for name, one in zip(FINGERS, self._last, strict=True)
        )
        return left, right


def _triple(values: np.ndarray) -> Triple:
    x, y, z = values.tolist()
    return x, y, z


def lift(
    world: PairWorld,
    clock: Now,
    load: Load,
    feel: Feel,
    settings: GripSettings,
    seen: Callable[[PairState, Pair, ForceGrip], None] = lambda *_: None,
) -> Lift:
    """Grip and lift one object; `seen` is called with every frame."""
    grip, result, fingers = ForceGrip(settings), Lift(load), Fingers(clock)
    fingers.obey(GripperCommand())
    clock.t_ns += 2_000_000_000
    start = CLOSED - math.ceil((load.object.width + 3e-3) / COUNT)
    fingers.obey(GripperCommand(go=True, position=start, speed=255))
    clock.t_ns += 3_000_000_000
    world.place(load.object)
    begun_ns, firm_ns, top_ns, fraction, height = clock.t_ns, 0, 0, 0.0, 0.0
    arriving: list[tuple[int, Pair]] = []
    left: FingerForce | None = None
    right: FingerForce | None = None
    command = None
    while not result.lifted and (spent_ns := clock.t_ns - begun_ns) < LONGEST_NS:
        t_ns = clock.t_ns
        status = fingers.status()
        opening = (CLOSED - status.position) * COUNT
        # The table gives way like a soft mat: it bears less, the higher the hand has lifted.
        state = world.step(t_ns, opening, (0.0, 0.0, fraction), fraction > 0)
        fraction = min(max((height - float(state.fallen[1])) / SAG, 0.0), 1.0)
        slid = float(state.slip.max())
        result.slid(t_ns, slid)
        if spent_ns % FRAME_NS == 0:
            arriving.append((t_ns + LATENCY_NS, feel(world, state)))
            seen(state, arriving[-1][1], grip)
        while arriving and arriving[0][0] <= t_ns:
            left, right = arriving.pop(0)[1]
            if left.slipping or right.slipping:
                result.slid(t_ns, slid, notice=True)
        if command is not None:
            fingers.obey(command)
        refused = grip.state == State.REFUSED
        senses = Senses(t_ns, left, right, status, t_ns, height > 0, release=refused)
        command = grip.step(senses)
        if grip.state != State.OPENED:
            result.reason = grip.reason
        if state.dropped or grip.state in (State.OPENED, State.LOST, State.GIVEN_UP):
            break
        firm_ns = firm_ns or (t_ns if grip.firm else 0)
        if refused or (grip.firm and t_ns - firm_ns > SETTLE_NS):
            height = min(max(height + (-RISE if refused else RISE), 0.0), TOP)
        top_ns = top_ns or (t_ns if height >= TOP and fraction == 1.0 else 0)
        result.lifted = bool(top_ns) and t_ns - top_ns > HOLD_NS
        clock.t_ns += STEP_NS
    result.state = grip.state
    result.force, result.seconds = float(-state.wrench[:, 2].mean()), 1e-9 * spent_ns
    result.slid(t_ns, slid, notice=False)
    return result


# The demo: all objects by pictures, by the truth, and by one force for all.


class Lifter:
    """World, clock and eyes of a process, in which it lifts one object after another."""

    def __init__(self, folder: str) -> None:
        self.world, self.clock = PairWorld(PairSpec(SENSOR, SENSOR)), Now()
        self.eyes = Eyes(self.world, folder)

    def lifts(self, load: Load, force: float | None) -> list[Lift]:
        """Lift by pictures, then by the truth; or with a force [N] and by nothing else."""
        feels: list[Feel] = [self.eyes.begin(), truth()]
        settings = GripSettings()
        if force is not None:
            feels, settings = [truth(slips=False)], GripSettings(least=force, friction=1e6)
        return [lift(self.world, self.clock, load, feel, settings) for feel in feels]


_lifter = cache(Lifter)


def _lifts(folder: str, load: Load, force: float | None) -> list[Lift]:
    return _lifter(folder).lifts(load, force)


def demo(seed: int, number: int, say: Callable[[str], None]) -> None:
    """Lift objects of a seed, and say how that went."""
    with ItemProgress("frames for the model of a finger", sys.stderr) as progress:
        folder = str(cached_model(progress, say))
    loads = drawn_loads(seed, number)
    with several(min(cores(), 2)) as workers, ItemProgress("lifts", sys.stderr) as progress:

        def run(force: float | None, before: int) -> list[list[Lift]]:
            tried = []
            for one in results(workers, _lifts, [(folder, load, force) for load in loads]):
                tried.append(one)
                progress(before + len(tried), 2 * number)
            return tried

        seen, true = zip(*run(None, 0), strict=True)
        mean = float(np.mean([one.force for one in seen if one.lifted] or [0.0]))
        fixed = [one for (one,) in run(max(mean, 0.1), number)]
    say(f"{'':10s} lifted     at the limit  forbidden, not lifted  mean force  over the least")
    for name, lifts in (("pictures", seen), ("truth", true), ("one force", fixed)):
        mean_force = np.mean([one.force for one in lifts if one.lifted] or [math.nan])
        say(
            f"{name:10s} {counted(lifts, 'allowed', lifted=True):10s} "
            f"{counted(lifts, 'limit', lifted=True):13s} "
            f"{counted(lifts, 'forbidden', lifted=False):22s} {mean_force:.2f} N      "
            f"{ratio(lifts, fine=True)}, {ratio(lifts, fine=False)} with coarse counts"
        )
    late = [1e3 * each for one in seen for each in one.noticed]
    say(
        f"slips of {1e6 * SLIP:.0f} um: {sum(each <= 1e3 * SOON for each in late)} of {len(late)} "
        f"noticed within {1e3 * SOON:.0f} ms; {sum(one.false_alarms for one in seen)} false alarms "
        f"in {sum(one.seconds for one in seen) / 60:.1f} simulated minutes"
    )
    lifted, margin = counted(seen, "allowed", lifted=True), ratio(seen, fine=True)
    say(f"lifted {lifted}  grip margin {margin}  slip noticed {_median(late, '.0f')} ms")


def counted(lifts: Sequence[Lift], kind: str, *, lifted: bool) -> str:
    """Return how many loads of a kind were lifted, or were not, and their number as text."""
    some = [one.lifted == lifted for one in lifts if one.load.kind == kind]
    return f"{sum(some)} of {len(some)}"


def ratio(lifts: Sequence[Lift], *, fine: bool) -> str:
    """Return the median of true over least forces of the lifted, with fine or coarse counts."""
    some = [one for one in lifts if one.lifted and one.load.is_fine == fine]
    return _median([one.force / one.load.least for one in some])


def _median(values: Sequence[float], form: str = ".2f") -> str:
    return format(float(np.median(values)), form) if len(values) else "-"
