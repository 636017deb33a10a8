"""How good translated images and predicted forces are: errors, distances, baselines, one report."""
