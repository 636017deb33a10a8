"""Second-order axisymmetric finite elements for a compressible neo-Hookean body.

Nine-node quadrilaterals with a dilatation that is linear in each of them (Q2/P1, stable even for
nearly incompressible materials: Boffi, Brezzi & Fortin, Mixed Finite Element Methods and
Applications, 2013, section 8.6). The energy is

    W = G/2 (J^(-2/3) |F|^2 - 3) + K/2 ((theta^2 - 1)/2 - ln theta),

where theta is the projection of J = det F onto 1, r, z in each element, weighted by the undeformed
volume: the three-field principle of Simo, Taylor & Pister (Comput. Methods Appl. Mech. Eng. 51
(1985) 177) with pressure and dilatation eliminated, which leaves only displacements as unknowns.
F = (F_rr, F_rz, F_zr, F_zz, F_hoop) has five nonzero entries.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.sparse import csc_matrix

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# Gauss points along each edge of an element.
POINTS = 3


def quadratic(place: Array) -> tuple[Array, Array]:
    """Return three quadratic shape functions at `place` (P,) in -1..1 and their slopes, (P, 3)."""
    value = np.stack([place * (place - 1) / 2, 1 - place**2, place * (place + 1) / 2], axis=-1)
    return value, np.stack([place - 0.5, -2 * place, place + 0.5], axis=-1)


@dataclass(frozen=True)
class Grid:
    """Elements between lines of r and of z, with nodes also halfway between lines."""

    r: Array
    """Lines of r [m], increasing from 0 (or from an inner radius)."""
    z: Array
    """Lines of z [m], increasing from the base to the top."""
    dome: float | None = None
    """Radius of a spherical top [m], to which all lines of z are scaled."""

    @property
    def nodes(self) -> Array:
        """Positions (N, 2) of the nodes [m], r slowest."""
        r, z = (np.sort([*lines, *(lines[1:] + lines[:-1]) / 2]) for lines in (self.r, self.z))
        nodes = np.stack(np.meshgrid(r, z, indexing="ij"), axis=-1).reshape(-1, 2)
        if self.dome is not None:
            lower = self.dome - np.sqrt(self.dome**2 - nodes[:, 0] ** 2)
            nodes[:, 1] -= lower * (nodes[:, 1] - z[0]) / (z[-1] - z[0])
        return nodes

    @property
    def elements(self) -> Index:
        """Node numbers (E, 9) of the elements, r slowest."""
        return sliding_window_view(self._numbers, (3, 3))[::2, ::2].reshape(-1, 9)

    @property
    def top(self) -> Index:
        """Node numbers (S, 3) of the element edges along the top."""
        return sliding_window_view(self._numbers[:, -1], 3)[::2]

    @property
    def _numbers(self) -> Index:
        rows, columns = 2 * len(self.r) - 1, 2 * len(self.z) - 1
        return np.arange(rows * columns).reshape(rows, columns)


class Elastic:
    """Stored energy of a mesh, of moduli G and K [Pa], as a function of its nodal displacements."""

    def __init__(self, grid: Grid, shear: float, bulk: float) -> None:
        self.shear, self.bulk = shear, bulk
        nodes, elements = grid.nodes, grid.elements
        self.count = 2 * len(nodes)
        self.unknowns = (2 * elements[:, :, None] + np.arange(2)).reshape(len(elements), 18)
        place, weight = np.polynomial.legendre.leggauss(POINTS)
        value, slope = quadratic(place)
        shape = np.einsum("pi,qj->pqij", value, value).reshape(-1, 9)
        along_r = np.einsum("pi,qj->pqij", slope, value).reshape(-1, 9)
        along_z = np.einsum("pi,qj->pqij", value, slope).reshape(-1, 9)
        r = np.einsum("pn,en->ep", shape, nodes[elements, 0])
        flat = np.outer(weight, weight).ravel()
        # Derivatives of position by reference coordinates (E, P, 2, 2), and of shapes by position.
        slopes = np.stack([along_r, along_z])
        ways = np.einsum("dpn,enc->epcd", slopes, nodes[elements])
        area = np.linalg.det(ways)
        over_r, over_z = np.einsum("epdc,dpn->cepn", np.linalg.inv(ways), slopes)
        self.volume: Array = 2 * math.pi * r * flat * area
        self.shape = shape
        # Operator from the 18 displacements to the five entries of F, (E, P, 5, 18).
        self.operator = np.zeros((*r.shape, 5, 18))
        self.operator[:, :, 0, 0::2] = over_r
        self.operator[:, :, 1, 0::2] = over_z
        self.operator[:, :, 2, 1::2] = over_r
        self.operator[:, :, 3, 1::2] = over_z
        self.operator[:, :, 4, 0::2] = shape / r[:, :, None]
        # Projection onto 1, r, z of each element, from values at points to coefficients.
        first, second = np.repeat(place, POINTS), np.tile(place, POINTS)
        self.linear = np.stack([np.ones_like(first), first, second], axis=1)
        mass = np.einsum("ep,pa,pb->eab", self.volume, self.linear, self.linear)
        self.inverse = np.linalg.inv(mass)

    def mass(self, density: float) -> csc_matrix:
        """Return the consistent mass (2 N, 2 N) [kg] of a density [kg/m^3]."""
        local = density * np.einsum("ep,pn,pm->enm", self.volume, self.shape, self.shape)
        both = np.einsum("enm,cd->encmd", local, np.eye(2)).reshape(len(local), 18, 18)
        return assembled(both, self.unknowns, self.count)

    def strain(self, u: Array) -> tuple[Array, Array, Array]:
        """Return F (E, P, 5), J and its projection theta, (E, P) each, at the points.

        Args:
            u: Displacements (2 N,) [m].
        """
        f: Array = np.matmul(self.operator, u[self.unknowns][:, None, :, None])[..., 0]
        f[:, :, [0, 3, 4]] += 1
        j = (f[..., 0] * f[..., 3] - f[..., 1] * f[..., 2]) * f[..., 4]
        return f, j, self._projected(j)

    def energy(self, u: Array) -> float:
        """Return the stored energy [J]; inf if an element is inverted."""
        f, j, theta = self.strain(u)
        if min(j.min(), theta.min()) <= 0:
            return math.inf
        density = self.shear / 2 * (j ** (-2 / 3) * np.sum(f * f, axis=-1) - 3)
        density += self.bulk / 2 * ((theta**2 - 1) / 2 - np.log(theta))
        return float(np.sum(density * self.volume))

    def force(self, u: Array) -> Array:
        """Return the first derivative of the energy (2 N,) [N]."""
        f, j, theta = self.strain(u)
        cofactor, square = _cofactor(f), np.sum(f * f, axis=-1)
        stress = f - (square / 3 / j)[..., None] * cofactor
        stress *= (self.shear * j ** (-2 / 3))[..., None]
        stress += self._pressure(theta)[..., None] * cofactor
        weighted = (stress * self.volume[..., None]).reshape(len(f), 1, -1)
        nodal = np.matmul(weighted, self.operator.reshape(len(f), -1, 18))
        whole = np.bincount(self.unknowns.ravel(), nodal.ravel(), self.count)
        return np.asarray(whole, np.float64)

    def tangent(self, u: Array) -> csc_matrix:
        """Return the second derivative of the energy (2 N, 2 N) [N/m]."""
        f, j, theta = self.strain(u)
        cofactor, second = _cofactor(f), _second(f)
        square = np.sum(f * f, axis=-1)
        log_slope = cofactor / j[..., None]
        mixed = outer(f, log_slope)
        stiff = np.eye(5) - 2 / 3 * (mixed + np.swapaxes(mixed, -1, -2))
        stiff += (5 / 9 * square)[..., None, None] * outer(log_slope, log_slope)
        stiff -= (square / 3 / j)[..., None, None] * second
        stiff *= (self.shear * j ** (-2 / 3))[..., None, None]
        stiff += self._pressure(theta)[..., None, None] * second
        weighted = np.matmul(stiff * self.volume[..., None, None], self.operator)
        shape = (len(f), -1, 18)
        across = np.swapaxes(self.operator.reshape(shape), 1, 2)
        tangent = np.matmul(across, weighted.reshape(shape))
        # Derivative of the coefficients of theta, (E, 3, 18), and the curvature of U along them.
        change = np.einsum("epi,epik->epk", cofactor, self.operator, optimize=True)
        moved = np.einsum("ep,pa,epk->eak", self.volume, self.linear, change, optimize=True)
        moved = np.matmul(self.inverse, moved)
        bend = self.bulk / 2 * (1 + theta**-2) * self.volume
        curve = np.einsum("ep,pa,pb->eab", bend, self.linear, self.linear, optimize=True)
        tangent += np.matmul(np.swapaxes(moved, 1, 2), np.matmul(curve, moved))
        return assembled(tangent, self.unknowns, self.count)

    def _pressure(self, theta: Array) -> Array:
        """Return the projection of dU/dtheta, which is the conjugate of J."""
        return self._projected(self.bulk / 2 * (theta - 1 / theta))

    def _projected(self, values: Array) -> Array:
        """Return the linear function nearest to `values` (E, P) in each element."""
        moments = (values * self.volume) @ self.linear
        return np.asarray(np.einsum("eab,eb->ea", self.inverse, moments) @ self.linear.T)


def assembled(local: Array, unknowns: Index, count: int) -> csc_matrix:
    """Return the sum (count, count) of matrices (E, M, M) of elements with `unknowns` (E, M)."""
    rows, columns = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
    return csc_matrix((local.ravel(), (rows.ravel(), columns.ravel())), shape=(count, count))


def outer(one: Array, other: Array) -> Array:
    """Return the products (..., M, N) of the entries of two vectors, (..., M) and (..., N)."""
    return one[..., :, None] * other[..., None, :]


def _cofactor(f: Array) -> Array:
    """Return the derivative of the determinant, (..., 5)."""
    rr, rz, zr, zz, hoop = np.moveaxis(f, -1, 0)
    return np.stack([zz * hoop, -zr * hoop, -rz * hoop, rr * hoop, rr * zz - rz * zr], axis=-1)


def _second(f: Array) -> Array:
    """Return the second derivative of the determinant, (..., 5, 5)."""
    rr, rz, zr, zz, hoop = np.moveaxis(f, -1, 0)
    second = np.zeros((*f.shape, 5))
    pairs = ((0, 3, hoop), (1, 2, -hoop), (0, 4, zz), (1, 4, -zr), (2, 4, -rz), (3, 4, rr))
    for first, other, value in pairs:
        second[..., first, other] = second[..., other, first] = value
    return second
