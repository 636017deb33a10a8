"""The undeformed tangent's diagonal blocks: what the preconditioner is made of, once for a mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from sim.fem.mesh import CORNERS, GAUSS, Mesh


def rest_blocks(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Diagonal blocks (N, 3, 3) of the undeformed tangent per shear and per bulk modulus."""
    signs = 2.0 * np.array(CORNERS) - 1.0
    shear = np.zeros((len(mesh.nodes), 3, 3))
    bulk = np.zeros_like(shear)
    volume = mesh.weight.sum(1)
    for corner in range(8):
        mean = np.zeros((len(mesh.elements), 3))
        block = np.zeros((len(mesh.elements), 3, 3))
        for point, place in enumerate(signs * GAUSS):
            factors = 1.0 + signs[corner] * place
            local = np.array(
                [signs[corner, a] * np.delete(factors, a).prod() / 8 for a in range(3)]
            )
            gradient = local @ mesh.inverse[:, point]
            weight = mesh.weight[:, point]
            square = (gradient**2).sum(1)
            outer = gradient[:, :, None] * gradient[:, None, :]
            block += weight[:, None, None] * (square[:, None, None] * np.eye(3) + outer / 3)
            mean += weight[:, None] * gradient
        np.add.at(shear, mesh.elements[:, corner], block)
        outer = mean[:, :, None] * mean[:, None, :] / volume[:, None, None]
        np.add.at(bulk, mesh.elements[:, corner], outer)
    return shear, bulk
