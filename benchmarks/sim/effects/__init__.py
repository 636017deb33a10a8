"""What an effect costs that is off, and what one costs that is on: `docs/results/effects.md`."""
