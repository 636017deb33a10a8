"""Play the person who lays weights on the simulated sensor of `make demo-transfer`.

    python examples/demo-transfer/weigh.py bare.markers.zarr:bare 50,100,200

For each mass [g], print the frame of a force-depth press whose force is nearest to it, and the mass
that rests on the sensor there: the options of `tactile calibrate-force`.
"""

from __future__ import annotations

import sys

import numpy as np

from recorder import MarkerArchive

GRAVITY = 9.80665


def main() -> None:
    """Print the options."""
    path, _, name = sys.argv[1].rpartition(":")
    table = MarkerArchive(path)[name].table
    force = -np.asarray(table["wrench"][:, 2], np.float64)
    rows = np.flatnonzero((table["location"] < 0) & table["valid"] & (force > 0.05))
    chosen, masses = [], []
    for grams in sys.argv[2].split(","):
        row = int(rows[np.argmin(np.abs(force[rows] - 1e-3 * GRAVITY * float(grams)))])
        chosen.append(str(row))
        masses.append(f"{1e3 * force[row] / GRAVITY:.2f}g")
    print(f"--archive {sys.argv[1]} --rows {','.join(chosen)} --weights {','.join(masses)}")


if __name__ == "__main__":
    main()
