"""Common parts of all trainings: run folders, seeded random choices, schedules, EMA, devices."""

from learning.training.run import (
    METRICS,
    LaunchSettings,
    RunFolder,
    Session,
    Stop,
    accelerator,
    described,
    generator,
)

__all__ = [
    "METRICS",
    "LaunchSettings",
    "RunFolder",
    "Session",
    "Stop",
    "accelerator",
    "described",
    "generator",
]
