"""Mock benches for short collections."""

from __future__ import annotations

from pathlib import Path


def quick_bench(
    folder: Path, sensor: str, benches: Path, *, limits: str = "{}", more: str = ""
) -> Path:
    """Write a mock bench with a short preflight and fast travel through free space.

    Args:
        folder: Folder to write it to.
        sensor: Sensor whose bench it extends.
        benches: Folder of the bench files.
        limits: YAML mapping merged over its limits.
        more: YAML to add, in which BENCHES is replaced by the folder of the bench files.

    Returns:
        Path of the bench file.
    """
    path = folder / "bench.yaml"
    path.write_text(
        f"""
extends: {benches.resolve() / f"{sensor}.yaml"}
preflight: {{rate_window: 0.4, tare_window: 0.2, point_window: 0.1}}
arm: {{travel_speed_mm_s: 100.0, travel_acceleration_mm_s2: 1000.0}}
limits: {limits}
{more.replace("BENCHES", str(benches.resolve()))}
"""
    )
    return path
