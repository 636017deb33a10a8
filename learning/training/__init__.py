"""Common parts of all trainings: run folders, seeded random choices, schedules, devices."""
