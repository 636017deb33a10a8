"""A made-up session of a hand with two pads, as `rig.acquire.squeeze` writes it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from recorder.session import SessionWriter, StreamWriter
from rig.acquire.squeeze import session_of
from rig.bench.bench import read_content
from rig.bench.pair import PairFile
from rig.core.packaged import BENCHES
from trajectories import Squeeze

SECOND = 10**9
TURNS = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
PLAN = Squeeze(turns=TURNS, steps=2, lift=2, settle=0.2, hold=0.2)
STEPS = list(PLAN.targets(2))
# Time of each step [s].
STEP = 0.5


def pads() -> PairFile:
    """Return the packaged bench with two pads and a short plan."""
    content = read_content(BENCHES / "pair.yaml")
    content["fingers"] = {"left": {"sensor": "uskin"}, "right": {"sensor": "uskin"}}
    file = PairFile.of_sensors(content, BENCHES / "pair.yaml")
    return replace(file, bench=replace(file.bench, squeeze=PLAN))


def begun_session(path: Path) -> SessionWriter:
    """Begin a session of two objects at two turns."""
    gripper = {"slave": 9, "per_count": 0.37e-3, "closed": 230}
    begun: dict[str, Any] = {"utc_ns": 1_700_000_000 * SECOND, "utc": "2023-11-14T22:13:20Z"}
    begun |= {"t0_ns": 0, "boot_id": "made-up", "operator": "nobody"}
    begun["devices"] = {"left": {}, "right": {}, "gripper": gripper}
    writer = session_of(pads(), path, STEPS, begun)
    writer.begin_run(begun)
    return writer


def hand_session(path: Path) -> Path:
    """Write a session whose third step is not steady."""
    bench, writer = pads().bench, begun_session(path)
    widths = [bench.objects[step.object].width - step.closing for step in STEPS]
    openings = [bench.gripper.opening(bench.gripper.position(width)) for width in widths]
    level, random = np.array([step.step for step in STEPS]), np.random.default_rng(0)
    for name, rate_hz in (("left", 60.0), ("right", 60.0), ("gripper", 25.0)):
        with StreamWriter.open(writer.stream_path(name)) as stream:
            for k, seconds in enumerate(np.arange(0.0, 1 + STEP * len(STEPS), 1 / rate_hz)):
                of = min(max(int((seconds - 0.5) / STEP), 0), len(STEPS) - 1)
                counts = 20_000 + 400 * level[of] + random.integers(-4, 5, (16, 3))
                row: dict[str, Any] = {"value": counts, "seq": k + 1, "device_t": np.nan}
                if name == "gripper":
                    row = {"value": openings[of], "commanded": openings[of], "current": 0.0}
                    row |= {"object": 3, "fault": 0}
                stream.append(**row, t_ns=round((10 + seconds) * SECOND))
    with StreamWriter.open(writer.stream_path("action")) as actions:
        for number, opening in enumerate(openings):
            first, last = (round((10.5 + STEP * k) * SECOND) for k in (number, number + 1))
            actions.append(value=opening, speed=0, force=0, by=0, t_ns=first)
            outcome = 4 if number == 2 else 0
            times = {"start_ns": first, "end_ns": last}
            writer.segments.append(target=number, phase=0, outcome=outcome, run=0, **times)
            if not STEPS[number].step:
                rest, none = np.full((16, 3), 20_000.0), np.full(6, np.nan)
                signals = {"image": -1, "taxels": rest, "right": rest}
                forces = {"wrench": none, "wrench_std": none}
                point = STEPS[number].point
                writer.reference.append(**signals, **forces, point=point, run=0, t_ns=last)
    writer.finish("complete", rate_hz=bench.rate_hz)
    return path
