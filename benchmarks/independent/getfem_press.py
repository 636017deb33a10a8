"""Press solved by GetFEM, an independent program, in an interpreter that has it.

    python3 -m benchmarks.independent.getfem_press NAME SCALE

prints the force on the body [N], as JSON, at each point of the path. SCALE multiplies the size of
every element. GetFEM (getfem.org; Debian: python3-getfem) assembles the weak
form written below and differentiates it; the mesh, Newton's method and the steps are ours. Elements
are of second order (20 nodes), units are millimetres and newtons. Contact uses an augmented
Lagrangian with a signed distance written in GetFEM's language; every indenter is a core grown by
its edge radius.
"""

import json
import math
import sys
from itertools import pairwise, product
from typing import Any

import getfem
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from benchmarks.independent.formulas import shear_and_bulk
from benchmarks.independent.mesh import Fine, graded
from benchmarks.independent.presses import MODULUS, PRESSES, Press

Array = NDArray[np.float64]

# Region numbers.
BASE, TOP = 1, 2
# Contact stiffness, in modulus per millimetre of contact radius.
STIFFNESS = 300.0
# Friction coefficient at which hardly any point slips.
STUCK = 50.0
GROWTH, CONVERGED, ITERATIONS, AUGMENTATIONS = 0.5, 1e-6, 14, 3
# Fractions of a Newton step, tried in turn.
FRACTIONS = (1.0, 0.5, 0.25, 0.125)
# First Piola-Kirchhoff stress of the material law in `sim`, at virtual displacements.
LAW = "(G*pow(Det(F),-2/3)*(F-Norm_sqr(F)/3*Inv(F)')+K/2*(sqr(Det(F))-1)*Inv(F)'):Grad_Test_u"


def lines(low: float, high: float, zones: Any, scale: float, coarsest: float) -> Array:
    """Return the lines between elements along one axis [mm]."""
    places = [Fine(start, end, size * scale) for start, end, size in zones]
    return graded(low, high, places, GROWTH, coarsest * scale)


def mesh_of(case: Press, scale: float) -> Any:
    """Return hexahedra between lines; with a dome, of second order and stretched to it along z."""
    size_x, size_y, thick = case.size
    x = lines(0.0 if "x" in case.mirrors else -size_x / 2, size_x / 2, case.x_zones, scale, 3.0)
    y = lines(0.0 if "y" in case.mirrors else -size_y / 2, size_y / 2, case.y_zones, scale, 3.0)
    finest = max(min(zone[2] for zone in case.x_zones), min(zone[2] for zone in case.y_zones))
    z = -lines(0.0, thick, [(0.0, 0.0, finest)], scale, thick / 3.5)[::-1]
    if case.dome is None:
        return getfem.Mesh("cartesian", x, y, z)
    mesh = getfem.Mesh("empty", 3)
    half = np.array([0.0, 0.5, 1.0])
    for spans in product(pairwise(x), pairwise(y), pairwise(z)):
        lines_zyx = [start + half * (end - start) for start, end in reversed(spans)]
        place = np.stack(np.meshgrid(*lines_zyx, indexing="ij"))[::-1].reshape(3, -1)
        top = np.sqrt(case.dome**2 - place[0] ** 2 - place[1] ** 2) - case.dome
        place[2] = -thick + (place[2] + thick) * (thick + top) / thick
        mesh.add_convex(getfem.GeoTrans("GT_QK(3,2)"), place)
    return mesh


def turned(case: Press) -> tuple[Array, float]:
    """Return the rotation of the indenter, and its rise that keeps its tip lowest [mm]."""
    if not any(case.tilt):
        return np.eye(3), 0.0
    turn = Rotation.from_rotvec([*case.tilt, 0.0], degrees=True)
    angle, edge = turn.magnitude(), case.measures[-1]
    far = case.measures[0] - edge if case.shape == "punch" else case.measures[1] / 2 - edge
    return turn.as_matrix(), far * math.sin(angle) + edge * (1 - math.cos(angle))


def distance(case: Press) -> str:
    """Return the signed distance as an expression of the place q in the indenter's frame."""
    measures = case.measures
    if case.shape == "spheres":
        radius = measures[0]
        each = [
            f"(sqrt(sqr(q(1)-({middle!r}))+sqr(q(2))+sqr(q(3)-{radius!r}))-{radius!r})"
            for middle in measures[1:] or (0.0,)
        ]
        return each[0] if len(each) == 1 else _least(*each)
    first, length, edge = measures[0], measures[1], measures[-1]
    flat_end = _beyond("-q(3)", -edge)
    if case.shape == "box":
        sides = [_beyond(_abs(1), first / 2 - edge), _beyond(_abs(2), length / 2 - edge), flat_end]
    elif case.shape == "punch":
        sides = [_beyond("sqrt(sqr(q(1))+sqr(q(2))+1e-20)", first - edge), flat_end]
    else:
        across = f"sqrt(sqr(q(1))+sqr(q(3)-{first!r})+1e-20)"
        sides = [_beyond(across, first - edge), _beyond(_abs(2), length / 2 - edge)]
    return f"sqrt({'+'.join(sides)}+1e-30)-{edge!r}"


def _beyond(place: str, limit: float) -> str:
    """Return the square of what `place` exceeds the limit by, 0 below it."""
    return f"2*half_sqr_pos_part({place}-({limit!r}))"


def _abs(axis: int) -> str:
    return f"(q({axis})*(2*step(q({axis}))-1))"


def _least(one: str, other: str) -> str:
    return f"({one}+({other}-{one})*step({one}-{other}))"


class Solver:
    """GetFEM model of a case, with Newton's method."""

    def __init__(self, case: Press, scale: float) -> None:
        self.case = case
        mesh = mesh_of(case, scale)
        mesh.set_region(BASE, mesh.outer_faces_with_direction([0, 0, -1], 0.01))
        mesh.set_region(TOP, mesh.outer_faces_with_direction([0, 0, 1], 0.6))
        self.field = getfem.MeshFem(mesh, 3)
        self.field.set_fem(getfem.Fem("FEM_Q2_INCOMPLETE(3)"))
        volume = getfem.MeshIm(mesh, getfem.Integ("IM_GAUSS_PARALLELEPIPED(3,4)"))
        self.surface = getfem.MeshIm(mesh, getfem.Integ("IM_GAUSS_PARALLELEPIPED(3,6)"))
        self.number = getfem.MeshImData(self.surface, TOP, 1)
        self.vector = getfem.MeshImData(self.surface, TOP, 3)
        self.free = self._free()
        self.model = self._model(volume)

    def _free(self) -> NDArray[np.int64]:
        places = self.field.basic_dof_nodes()
        axis = np.arange(places.shape[1]) % 3
        held = np.abs(places[2] + self.case.size[2]) < 1e-9
        for index, name in enumerate("xy"):
            if name in self.case.mirrors:
                held |= (np.abs(places[index]) < 1e-9) & (axis == index)
        return np.flatnonzero(~held)

    def _model(self, volume: Any) -> Any:
        case, model = self.case, getfem.Model("real")
        # Heaviside(t) with a derivative of 0, so that expressions with it can be differentiated.
        getfem.asm_define_function("step", 1, "Heaviside(t)", "0*t")
        modulus = MODULUS * 1e-6
        shear, bulk = shear_and_bulk(modulus, case.poisson)
        model.add_fem_variable("u", self.field)
        model.add_initialized_data("G", shear)
        model.add_initialized_data("K", bulk)
        model.add_macro("F", "(Id(3)+Grad_u)")
        model.add_nonlinear_term(volume, LAW)
        model.add_initialized_data("eps", STIFFNESS * modulus / 2.0)
        model.add_initialized_data("tip", np.zeros(3))
        turn, raised = turned(case)
        rows = ";".join(",".join(repr(float(value)) for value in row) for row in turn.T)
        model.add_initialized_data("lift", np.array([0.0, 0.0, raised]))
        model.add_im_data("multiplier", self.number)
        model.set_variable("multiplier", np.zeros(self.number.nbpts()))
        model.add_macro("q", f"([{rows}]*(X+u-tip-lift))" if raised else "(X+u-tip)")
        model.add_macro("push", f"pos_part(multiplier-eps*({distance(case)}))")
        self.contact = f"half_sqr_pos_part(multiplier-eps*({distance(case)}))/eps"
        if case.friction:
            # Coulomb's law by return mapping, for one sphere.
            model.add_initialized_data("mu", case.friction)
            model.add_initialized_data("lower", np.array([0.0, 0.0, case.measures[0]]))
            model.add_initialized_data("travel", np.zeros(3))
            model.add_fem_data("old", self.field)
            model.add_im_data("shear", self.vector)
            model.set_variable("shear", np.zeros(3 * self.vector.nbpts()))
            model.add_macro("n", "Normalized(X+u-tip-lower)")
            model.add_macro("trial", "(shear-eps*(u-old-travel))")
            model.add_macro("rub", "Ball_projection(trial-(trial.n)*n,mu*push)")
            self.contact = "-(push*n+rub).Test_u"
        model.add_nonlinear_term(self.surface, self.contact, TOP)
        return model

    def force(self) -> Array:
        """Return the force of the indenter on the whole body (3,) [N]."""
        nodal = getfem.asm_generic(self.surface, 1, self.contact, TOP, self.model)
        sums = -np.asarray(nodal).reshape(-1, 3)[: self.field.nbdof() // 3].sum(axis=0)
        whole = [name not in self.case.mirrors for name in "xyz"]
        return np.asarray(2.0 ** len(self.case.mirrors) * np.where(whole, sums, 0.0))

    def move(self, tip: Array, guess: Array | float = 0.0) -> bool:
        """Apply Newton's method to a tip at `tip`; return True if it converges.

        It starts from the current body, displaced by `guess` [mm] at its nodes.
        """
        model, before = self.model, self.model.variable("u")
        travel = tip - model.variable("tip")
        if self.case.friction:
            model.set_variable("old", before)
            model.set_variable("travel", travel)
        was = model.variable("tip")
        model.set_variable("tip", tip)
        model.set_variable("u", before + guess)
        # With friction, first solve as if all points stick: from the undisplaced body, all points
        # would slip in the first iteration, and nothing would restrain it sideways.
        if self.case.friction:
            model.set_variable("mu", STUCK)
            if not self._balanced():
                model.set_variable("u", before + guess)
            model.set_variable("mu", self.case.friction)
        if self._balanced():
            if self.case.friction:
                model.set_variable("shear", model.interpolation("rub", self.vector, TOP))
            return True
        model.set_variable("u", before)
        model.set_variable("tip", was)
        return False

    def _balanced(self) -> bool:
        """Apply Newton's method from the current body; return True if it converges."""
        norm = self._residual(self.model.variable("u"))
        for _ in range(ITERATIONS):
            if not math.isfinite(norm):
                return False
            if norm < CONVERGED * max(float(np.linalg.norm(self.force())), 1e-9):
                return True
            norm = self._improved(norm)
        return False

    def _residual(self, u: Array) -> float:
        """Return the norm of the residual with displacements `u` [N]."""
        self.model.set_variable("u", u)
        self.model.assembly("build_all")
        return float(np.linalg.norm(self._unbalanced()))

    def _unbalanced(self) -> Array:
        return np.asarray(self.model.rhs())[self.free]

    def _improved(self, norm: float) -> float:
        """Take one Newton step, shortened if that helps; return the norm of the residual [N]."""
        start, change = self.model.variable("u"), np.zeros(self.field.nbdof())
        matrix = getfem.Spmat("copy", self.model.tangent_matrix(), self.free, self.free)
        change[self.free] = np.ravel(getfem.linsolve_mumps(matrix, self._unbalanced()))
        left = {}
        for fraction in FRACTIONS:
            left[fraction] = self._residual(start + fraction * change)
            # NaN, from an inverted element, does not compare as less.
            if left[fraction] < norm:
                return left[fraction]
        finite = [fraction for fraction in FRACTIONS if math.isfinite(left[fraction])]
        if not finite:
            return math.nan
        return self._residual(start + min(finite, key=lambda fraction: left[fraction]) * change)

    def settle(self) -> None:
        """Update the multipliers, so that no penetration remains."""
        for _ in range(AUGMENTATIONS):
            before = self.model.variable("multiplier")
            force = self.force()
            self.model.set_variable(
                "multiplier", self.model.interpolation("push", self.number, TOP)
            )
            if not self.move(self.model.variable("tip")):
                self.model.set_variable("multiplier", before)
                return
            if np.linalg.norm(self.force() - force) < 2e-4 * np.linalg.norm(force):
                return


def main(name: str, scale: float) -> int:
    """Solve a case and print each of its forces."""
    case = next(press for press in PRESSES if press.name == name)
    solver = Solver(case, scale)
    start = np.array([case.path[0][0], case.path[0][1], 0.0])
    heading = np.zeros(3)
    for x, y, depth in case.path:
        aim = np.array([x, y, -depth])
        length = float(np.linalg.norm(aim - start))
        # Displacement of the body per displacement of the tip, in the last step in this direction.
        # Without it, the indenter is so deep that Newton's method starts at a hundredfold pressure.
        if heading @ (aim - start) < 0.99 * length:
            rate = np.zeros(solver.field.nbdof())
        heading = (aim - start) / length
        parts = 6 if case.friction else 3
        fraction, step = 0.0, 1.0 / parts
        while fraction < 1 - 1e-9:
            ahead = min(1.0, fraction + step)
            before, way = solver.model.variable("u"), (ahead - fraction) * length
            if solver.move(start + ahead * length * heading, way * rate):
                rate = (solver.model.variable("u") - before) / way
                fraction, step = ahead, min(1.0 / parts, 1.5 * step)
            else:
                step /= 2
                if step < 1e-3:
                    print(f"{name}: no balance", file=sys.stderr)
                    return 1
        solver.settle()
        start = aim
        print(json.dumps(solver.force().tolist()), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], float(sys.argv[2])))
