"""The paper's tables from experiments with groups of sensors."""
