"""Randomly drawn hard cases, judged by a referee that is independent of the solver."""
