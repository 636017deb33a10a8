"""Evaluation of translated images and predicted forces: errors, distances, baselines, report."""
