"""Cost of physical effects, switched off and on: `docs/results/effects.md`."""
