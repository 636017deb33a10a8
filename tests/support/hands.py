"""A made-up session of a hand with two pads, as `rig.acquire.squeeze` writes it."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from recorder.session import StreamWriter
from rig.acquire.squeeze import session_of
from rig.bench.bench import read_content
from rig.bench.pair import PairFile
from rig.core.packaged import BENCHES
from trajectories import Squeeze

SECOND = 10**9
TURNS = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
PLAN = Squeeze(turns=TURNS, steps=2, lift=2, settle=0.2, hold=0.2)
# Time of each step [s].
STEP = 0.5


def pair_file(left: str = "uskin", right: str = "uskin", plan: Squeeze = PLAN) -> PairFile:
    """Return the packaged bench with these sensors and a plan."""
    content = {**read_content(BENCHES / "pair.yaml"), "fingers": {"left": {"sensor": left}}}
    content["fingers"]["right"] = {"sensor": right}
    file = PairFile.of_sensors(content, BENCHES / "pair.yaml")
    return replace(file, bench=replace(file.bench, squeeze=plan))


def hand_session(path: Path) -> Path:
    """Write a session of two objects at two turns, the third step not steady."""
    file = pair_file()
    bench = file.bench
    steps = list(PLAN.targets(len(bench.objects)))
    gripper = {"slave": 9, "per_count": bench.gripper.per_count, "closed": bench.gripper.closed}
    begun = {
        "utc_ns": 1_700_000_000 * SECOND,
        "utc": "2023-11-14T22:13:20Z",
        "t0_ns": 0,
        "boot_id": "made-up",
        "operator": "nobody",
        "devices": {"left": {}, "right": {}, "gripper": gripper},
    }
    writer = session_of(file, path, steps, begun)
    writer.begin_run(begun)
    start = round((1 + STEP * len(steps)) * SECOND)
    level = np.array([step.step for step in steps])
    widths = [bench.objects[step.object].width - step.closing for step in steps]
    openings = [bench.gripper.opening(bench.gripper.position(width)) for width in widths]
    random = np.random.default_rng(0)
    for name, rate_hz in (("left", 60.0), ("right", 60.0), ("gripper", 25.0)):
        times = np.arange(0.0, start / SECOND, 1 / rate_hz)
        of = np.clip(((times - 0.5) / STEP).astype(int), 0, len(steps) - 1)
        with StreamWriter.open(writer.stream_path(name)) as stream:
            for k, seconds in enumerate(times):
                row = {"t_ns": round((10 + seconds) * SECOND)}
                if name == "gripper":
                    due = openings[of[k]]
                    row |= {"value": due, "commanded": due, "current": 0.0, "object": 3, "fault": 0}
                else:
                    counts = 20_000 + 400 * level[of[k]] + random.integers(-4, 5, (16, 3))
                    row |= {"value": counts, "seq": k + 1, "device_t": np.nan}
                stream.append(**row)
    with StreamWriter.open(writer.stream_path("action")) as actions:
        for number, opening in enumerate(openings):
            t_ns = round((10.5 + STEP * number) * SECOND)
            actions.append(value=opening, speed=0, force=0, by=0, t_ns=t_ns)
    for number, step in enumerate(steps):
        first = round((10.5 + STEP * number) * SECOND)
        last = round((10.5 + STEP * (number + 1)) * SECOND)
        outcome = 4 if number == 2 else 0
        times = {"start_ns": first, "end_ns": last}
        writer.segments.append(target=number, phase=0, outcome=outcome, run=0, **times)
        if not step.step:
            rest = np.full((16, 3), 20_000.0)
            fixed = {"image": -1, "wrench": np.full(6, np.nan), "wrench_std": np.full(6, np.nan)}
            more = {"taxels": rest, "right": rest, "point": step.point, "run": 0, "t_ns": last}
            writer.reference.append(**fixed, **more)
    writer.finish("complete", rate_hz=bench.rate_hz)
    return path
