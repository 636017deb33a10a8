"""Archives, sessions and GenForce folders whose presses follow a plan, without any physics."""

import json
from collections.abc import Callable, Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from support.learning_sessions import CONTACT_FRAME, PHASE_NS, T0, write_session

from recorder import MarkerArchive, force_spec, pose_spec, taxels_spec
from recorder.archive import ArchivePlan, ArchiveWriter, SensorPlan
from recorder.markers import pack, unpack
from trajectories import PHASES, PressShear, Target, plan_to_json

WRENCH = "Fx(N),Fy(N),Fz(N),Tx(Nmm),Ty(Nmm),Tz(Nmm)"
HEADER = "X(m),Y(m),Z(m),RX(rad),RY(rad),RZ(rad)"

_YX = np.mgrid[:480, :640]
MASK = pack(((_YX[0] % 60 < 20) & (_YX[1] % 60 < 20))[None])


def tips(plan: PressShear, target: Target) -> list[tuple[int, np.ndarray]]:
    """Return phase and place (3,) [m] of two frames of each phase, the last at its end."""
    found = []
    for move in plan.moves(target):
        start, end = np.array(move.start), np.array(move.end)
        found += [(move.phase, (start + end) / 2), (move.phase, end)]
    return found


def planned_archive(
    path: Path,
    plans: dict[str, PressShear],
    indenters: Sequence[str] = ("sphere",),
    *,
    moved: float = 0.0,
    seen: bool = True,
    wrench: Sequence[float] = (float("nan"),) * 6,
) -> MarkerArchive:
    """Write an archive whose sensors were pressed as planned, two frames a phase.

    Each indenter pressed all targets; every place is off by `moved` along x and y [m], and every
    frame has the label `wrench` (6,) [N, N m].
    """
    rows = {name: 8 * len(plan) * len(indenters) for name, plan in plans.items()}
    planned = tuple(
        SensorPlan(name, rows[name], 8, 8 * len(plan), MASK, 0.03) for name, plan in plans.items()
    )
    writer = ArchiveWriter.begin(path, ArchivePlan(planned, tuple(indenters)))
    for name, plan in plans.items():
        for code in range(len(indenters)):
            frames = [
                (number, phase, tip, plan.height(*target.origin[:2]))
                for number, target in enumerate(plan.targets())
                for phase, tip in tips(plan, target)
            ]
            number, phase, tip, height = (np.array(column) for column in zip(*frames, strict=True))
            count = len(frames)
            table = {
                "indenter": np.full(count, code),
                "seen": np.full(count, seen),
                "location": code * len(plan) + number,
                "target": number,
                "phase": phase,
                "depth": np.maximum(height - tip[:, 2], 0.0),
                "position": tip[:, :2] + moved,
                "wrench": np.tile(np.array(wrench), (count, 1)),
                "frame": np.tile(np.arange(8), len(plan)),
                "t_ns": np.zeros(count, np.int64),
                "reference": np.zeros(count, np.int64),
                "valid": np.ones(count, np.bool_),
            }
            source = [json.dumps({"planned": each}) for each in number.tolist()]
            writer.sensors[name].write(
                code, packed=np.repeat(MASK, count, axis=0), table=table, source=source
            )
    writer.finish()
    return MarkerArchive(path)


def planned_session(path: Path, plan: PressShear, *, sensor: str, indenter: str) -> Path:
    """Record a session of taxels whose arm follows a plan, 0.1 s a phase."""
    targets = list(plan.targets())
    table = {
        "point": np.array([target.point for target in targets], np.int16),
        "depth": np.array([target.depth for target in targets]),
        "direction": np.array([target.direction for target in targets], np.int16),
        "planned": np.array([target.sheared for target in targets]) + CONTACT_FRAME[:3],
    }
    attrs = {
        "sensor": sensor,
        "indenter": indenter,
        "contact_frame": CONTACT_FRAME,
        "started_utc": "2026-01-01T00:00:00Z",
        "plan": plan_to_json(plan),
    }
    specs = [taxels_spec(60), force_spec(100), pose_spec(200)]
    moves = [move for target in targets for move in plan.moves(target)]
    starts, ends = (np.array([getattr(move, at) for move in moves]) for at in ("start", "end"))
    rows: dict[str, list[dict[str, Any]]] = {"taxels": [], "force": [], "pose": []}
    for name, rate in (("taxels", 60), ("force", 100), ("pose", 200)):
        times = np.arange(0, len(moves) * PHASE_NS, round(1e9 / rate))
        # The arm rests for the second half of each phase.
        phase, within = np.divmod(times, PHASE_NS)
        way = np.minimum(within / PHASE_NS / 0.5, 1.0)[:, None]
        tip = (1 - way) * starts[phase] + way * ends[phase]
        for number, t_ns in enumerate(times.tolist()):
            row: dict[str, Any] = {"t_ns": T0 + t_ns}
            if name == "pose":
                value = np.add(CONTACT_FRAME, [*tip[number], 0, 0, 0])
                row |= {"value": value, "device_t": 1e-9 * t_ns, "speed_scaling": 1.0}
            elif name == "force":
                row |= {"value": np.zeros(6), "seq": number, "status": 0}
            else:
                value = np.full((16, 3), 30_000, np.int32)
                row |= {"value": value, "device_t": 1e-9 * t_ns, "seq": number}
            rows[name].append(row)
    return write_session(path, attrs, specs, table, rows, first_ns=T0, rate_hz=60)


def raw_folder(root: Path, plan: PressShear, *, indenter: str) -> Path:
    """Write a collection run of taxels in the layout of the paper's authors."""
    run, origin = f"{indenter}-20250517_101010", np.array([-0.12, -0.43, 0.16])
    for target in plan.targets():
        for phase, name in enumerate(PHASES):
            some = [tip for code, tip in tips(plan, target) if code == phase]
            if phase == 0:
                some.insert(0, np.array(target.origin))
            place = Path(run) / str(target.index + 1) / name
            counts, poses = root / "uskin_raw" / place, root / "pose" / place
            counts.mkdir(parents=True)
            poses.mkdir(parents=True)
            lines = [
                ",".join(f"{value:.9f}" for value in (*(origin + tip), 0, 3.14, 0)) for tip in some
            ]
            (poses / "pose.csv").write_text("\n".join([HEADER, *lines]) + "\n")
            for frame in range(len(some)):
                np.save(counts / f"{frame:04d}.npy", np.zeros((16, 3), np.int64))
    return root


def training_folder(
    root: Path,
    sensors: Sequence[str],
    indenters: Sequence[str],
    points: int,
    *,
    last: Sequence[int] = (1, 3, 5, 7),
    mask_of: Callable[[int], Any] = lambda _: unpack(MASK[0]),
    force_of: Callable[[int], Any] | None = None,
    depths: bool = False,
    suffix: str = ".npy",
) -> Path:
    """Write a training folder of the paper's authors: masks by number, without places.

    `last` are the last frames of the four phases of every press. `mask_of` is called with sensor,
    indenter, point and frame added up, `force_of` with ten times the indenter and the point.
    """
    images = root / "img" / suffix[1:]
    presses = product(enumerate(sensors), enumerate(indenters), range(1, points + 1))
    for (s, sensor), (i, indenter), point in presses:
        folder, forces, depth = (
            kind / sensor / indenter / str(point)
            for kind in (images, root / "force", root / "depth")
        )
        folder.mkdir(parents=True)
        for frame in range(last[-1] + 1):
            write_mask(folder / f"{frame:04d}{suffix}", mask_of(s + i + point + frame))
        names = [f"C:\\data\\{point}\\{frame:04d}{suffix}" for frame in last]
        (folder / "last.csv").write_text("\n".join(names) + "\n")
        if force_of is not None:
            forces.mkdir(parents=True)
            rows = [",".join(f"{v:.6f}" for v in row) for row in force_of(10 * i + point)]
            (forces / "ft.csv").write_text("\n".join([WRENCH, *rows]) + "\n")
        if depths:
            depth.mkdir(parents=True)
            ends = [0, last[0], last[2], last[3]]
            below = np.interp(np.arange(last[3] + 1), ends, [0, point, point, 0]) / 5
            np.savetxt(depth / "inc_z.csv", below[: last[1] + 1])
            np.savetxt(depth / "dec_z.csv", below[last[1] + 1 :])
    for s, sensor in enumerate(sensors):
        write_mask(images / f"{sensor}_ref{suffix}", mask_of(100 * s))
    return root


def write_mask(path: Path, mask: Any) -> None:
    """Write a mask as the authors do: packed, or as a picture."""
    if path.suffix == ".npy":
        np.save(path, pack(mask[None])[0])
    else:
        Image.fromarray((mask * 255).astype(np.uint8)).save(path, quality=90)
