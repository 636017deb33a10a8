"""The paper's models trained from nothing on simulated sensors, beside simple baselines."""
