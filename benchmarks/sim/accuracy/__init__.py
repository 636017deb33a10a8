"""Error, time and memory of every tier and mesh; writes docs/results/accuracy.md."""
