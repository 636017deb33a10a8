"""What every training needs: run folders, chance without state, schedules, averages, devices."""

from learning.training.run import (
    METRICS,
    LaunchSettings,
    RunFolder,
    Stop,
    accelerator,
    described,
    generator,
)

__all__ = [
    "METRICS",
    "LaunchSettings",
    "RunFolder",
    "Stop",
    "accelerator",
    "described",
    "generator",
]
