"""Common closed-form solutions, which treat the gel as a half-space and take no time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from benchmarks.independent.formulas import cone, flat_punch, hertz
from sim.scene import Scene


def closed_form(case: str, scene: Scene) -> NDArray[np.float64] | None:
    """Return the force of the indenter on the body (F, 3) [N], or None without a common formula.

    Hertz, and Sneddon's punch and (sharp) cone.
    """
    material = (scene.body.modulus, scene.body.poisson)
    values = scene.indenter.parts[0].values
    depths = np.maximum(-np.array(scene.motion.tip)[:, 2], 0.0).tolist()
    if case == "sphere":
        normal = [hertz(depth, values[2], *material) for depth in depths]
    elif case == "punch":
        normal = [flat_punch(depth, values[2], *material) for depth in depths]
    elif case == "cone":
        normal = [cone(depth, float(np.arccos(values[0])), *material) for depth in depths]
    else:
        return None
    force = np.zeros((len(depths), 3))
    force[:, 2] = -np.array(normal)
    return force
