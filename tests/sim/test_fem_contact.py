import itertools
from typing import Any

import numpy as np
import pytest
import warp as wp
from support import fem_oracles as oracle
from support.fem_oracles import Array, Rubbing

from sim.fem.contact import contact_kernels, face_rule
from sim.indenters import flat_punch, named, plane, sphere
from sim.indenters.device import PartTable
from sim.scalars import matrix_of, vector_of

MESHES = oracle.domed_meshes()
# Their topology is the same.
MESH = MESHES[0]
VARIANT = [1, 0, 1, 0]
PLACED = [MESHES[variant] for variant in VARIANT]
UNIT = 3e-3
PENALTY, STICK = 1000.0, 0.1
# One per environment.
INDENTERS = [sphere(2e-3), flat_punch(1.5e-3, 0.3e-3), named("triangle"), plane()]
TIPS = np.array([[0.02, 0.05, -0.12], [0.05, -0.03, -0.1], [0.0, 0.0, -0.15], [0.1, 0.0, -0.2]])


def _rubbing(points: int) -> list[Rubbing]:
    """Return the previous step's friction state per environment: some points stick, some slip."""
    random = np.random.default_rng(21)
    shape = len(MESH.faces), points
    return [
        Rubbing(
            coefficient=coefficient,
            stick=STICK,
            tip_old=tip + random.normal(0, 0.01, 3),
            u_old=random.normal(0, 0.01, MESH.nodes.shape),
            traction_old=random.normal(0, 2.0, (*shape, 3)),
            limit=random.uniform(0, 20.0, shape),
        )
        for coefficient, tip in zip((0.1, 0.3, 1.0, 0.4), TIPS, strict=True)
    ]


def _multiplier(points: int) -> Array:
    """Return multipliers (B, S, P) that close gaps of up to 0.03 thicknesses; half are zero."""
    shape = len(INDENTERS), len(MESH.faces), points
    return np.maximum(np.random.default_rng(17).uniform(-30, 30, shape), 0.0)


def _displacements() -> Array:
    return np.random.default_rng(9).normal(0, 0.01, (len(INDENTERS), *MESH.nodes.shape))


class Contact:
    """The contact kernels on the indenters of `INDENTERS`, one per environment."""

    def __init__(
        self,
        real: Any,
        friction: list[Rubbing] | None,
        points: int = 2,
        multiplier: Array | None = None,
        variant: list[int] = VARIANT,
    ) -> None:
        self.real, self.friction, self.variant = real, friction, variant
        self.convex = False
        self.rule = face_rule(points)
        self._contact, self._tangent = contact_kernels(real, friction is not None)
        self._mesh = oracle.on_device(MESHES, variant, real, points)
        shape = len(INDENTERS), len(MESH.faces)
        vec3, mat33 = vector_of(real), matrix_of(real)
        many = (*shape, points * points)
        none = (0, 0, 0)
        self.out = {
            "force": oracle.zeros((*shape, 4), vec3),
            "touched": oracle.zeros(shape, wp.int32),
            "pressure": oracle.zeros(many, real),
            "normal": oracle.zeros(many, vec3),
            "traction": oracle.zeros(none if friction is None else many, vec3),
            "matrix": oracle.zeros(many, mat33),
            "energy": oracle.zeros(shape, real),
        }
        self.multiplier = np.zeros(many) if multiplier is None else multiplier
        self._table = PartTable.pack(INDENTERS, UNIT, real, "cpu").struct
        self._active = oracle.integers(np.ones(len(INDENTERS)))

    def evaluate(self, u: Array, tips: Array = TIPS) -> dict[str, Array]:
        real, many = self.real, self.friction or []
        old = (
            _none()
            if self.friction is None
            else tuple(
                np.stack([getattr(one, name) for one in many])
                for name in ("tip_old", "u_old", "traction_old", "limit")
            )
        )
        state = oracle.contact_of(
            real,
            penalty=real(PENALTY),
            stick=real(STICK),
            coefficient=oracle.scalars([one.coefficient for one in many] or [0.0] * len(u), real),
            convex=oracle.integers(np.full(len(u), self.convex)),
            tip=oracle.vectors(tips, real),
            tip_old=oracle.vectors(old[0], real),
            u_old=oracle.vectors(old[1], real),
            traction_old=oracle.vectors(old[2], real),
            limit=oracle.scalars(old[3], real),
            multiplier=oracle.scalars(self.multiplier, real),
            **self.out,
        )
        inputs = [self._mesh, self._table, state, self._active, oracle.vectors(u, real)]
        wp.launch(self._contact, dim=(len(u), len(MESH.faces)), inputs=inputs, device="cpu")
        return {name: array.numpy().astype(float) for name, array in self.out.items()}

    def tangent(self, v: Array) -> Array:
        """Return the derivative of -force along `v` at the state evaluated last."""
        shape = len(v), len(MESH.faces)
        product = oracle.zeros((*shape, 4), vector_of(self.real))
        state = oracle.contact_of(self.real, **{**self.out, "force": product})
        inputs = [self._mesh, state, self._active, oracle.vectors(v, self.real)]
        wp.launch(self._tangent, dim=shape, inputs=inputs, device="cpu")
        return np.asarray(product.numpy(), float)


def _none() -> tuple[Array, ...]:
    count = len(INDENTERS)
    nodes = np.zeros((count, *MESH.nodes.shape))
    return np.zeros((count, 3)), nodes, np.zeros((0, 0, 0, 3)), np.zeros((0, 0, 0))


def _expected(
    u: Array, friction: list[Rubbing] | None, points: int, multiplier: Array
) -> list[dict[str, Array]]:
    rule = face_rule(points)
    return [
        oracle.contact(
            PLACED[env],
            rule,
            indenter,
            UNIT,
            TIPS[env],
            PENALTY,
            multiplier[env],
            u[env],
            friction[env] if friction else None,
        )
        for env, indenter in enumerate(INDENTERS)
    ]


AUGMENTED = pytest.mark.parametrize("augmented", [False, True], ids=["penalty", "augmented"])
RUBS = pytest.mark.parametrize("rubs", [False, True], ids=["frictionless", "friction"])


@AUGMENTED
@pytest.mark.parametrize("points", [2, 3])
@RUBS
@pytest.mark.parametrize(
    ("real", "error"),
    [pytest.param(wp.float64, 1e-10, id="float64"), pytest.param(wp.float32, 1e-3, id="float32")],
)
def test_contact_is_that_of_the_hosts_distance_and_a_return_map(
    real: Any, error: float, rubs: bool, points: int, augmented: bool
) -> None:
    friction = _rubbing(points * points) if rubs else None
    multiplier = _multiplier(points * points) * augmented
    u = _displacements()
    found = Contact(real, friction, points, multiplier).evaluate(u)
    slips = touches = 0
    for env, expected in enumerate(_expected(u, friction, points, multiplier)):
        assert expected["touched"].any()
        bridged = (expected["gap"] > 0) & (expected["pressure"] > 0)
        assert bridged.any() == augmented, "a gap is bridged by a multiplier only"
        np.testing.assert_array_equal(found["touched"][env], expected["touched"])
        names = ("force", "pressure", "energy", "normal") + (("traction",) if rubs else ())
        for name in names:
            assert oracle.relative(found[name][env], expected[name]) < error, name
        slips += int(expected["slips"].sum())
        touches += int(expected["touched"].sum())
    assert not rubs or 0.1 < slips / touches < 0.9, "nearly all stick, or nearly all slip"


def _slope(contact: Contact, name: str, u: Array, v: Array, step: float) -> Array:
    """Return the central difference along `v` of what is evaluated."""
    ahead, behind = (contact.evaluate(u + move * v)[name] for move in (step, -step))
    return np.asarray((ahead - behind) / (2 * step))


@AUGMENTED
@pytest.mark.parametrize(
    ("rubs", "indenter", "step", "error"),
    [(False, 0, 1e-7, 1e-4), (False, 3, 1e-7, 1e-8), (True, 3, 1e-8, 1e-6)],
    ids=["sphere", "plane", "plane with friction"],
)
def test_the_contact_tangent_is_the_derivative_of_the_force(
    rubs: bool, indenter: int, step: float, error: float, augmented: bool
) -> None:
    """For points that stay in or out, stick or slip: the normal turns on a sphere, not on a plane.

    The limit of friction is given, as by the Newton loop.
    """
    friction = _rubbing(4) if rubs else None
    u = _displacements()
    contact = Contact(wp.float64, friction, multiplier=_multiplier(4) * augmented)
    v = np.random.default_rng(1).normal(0, 1, u.shape)
    slope = _slope(contact, "force", u, v, step)
    touched = contact.evaluate(u)["touched"][indenter] > 0
    product = contact.tangent(v)
    assert oracle.relative(-product[indenter][touched], slope[indenter][touched]) < error


def test_a_convex_contact_tangent_has_no_negative_stiffness() -> None:
    contact = Contact(wp.float64, _rubbing(4))
    least = []
    for convex in (False, True):
        contact.convex = convex
        matrix = contact.evaluate(_displacements())["matrix"]
        least.append(np.linalg.eigvalsh((matrix + np.swapaxes(matrix, -1, -2)) / 2).min())
    assert least[0] < -1e-2
    assert least[1] > -1e-9


@AUGMENTED
@RUBS
def test_contact_force_is_the_slope_of_the_energy(rubs: bool, augmented: bool) -> None:
    """Normal springs and the Huber potential of friction, on a plane, whose normal is constant."""
    u = _displacements()
    contact = Contact(
        wp.float64, _rubbing(4) if rubs else None, multiplier=_multiplier(4) * augmented
    )
    v = np.random.default_rng(6).normal(0, 1, u.shape)
    slope = _slope(contact, "energy", u, v, 1e-6).sum(1)
    work = -np.einsum("bsai,bsai->b", contact.evaluate(u)["force"], v[:, MESH.faces])
    assert slope[3] == pytest.approx(work[3], rel=1e-6)
    if not rubs:
        assert slope == pytest.approx(work, rel=1e-6)


def test_a_gap_is_bridged_up_to_the_pressure_carried_over_the_penalty_and_then_let_go() -> None:
    """Under a plane over the undeformed body: pressure = multiplier - penalty * gap, or none."""
    most = 25.0
    shape = len(INDENTERS), len(MESH.faces), 4
    contact = Contact(wp.float64, None, multiplier=np.full(shape, most))
    rest = np.zeros((len(INDENTERS), *MESH.nodes.shape))
    top = np.einsum("pa,sa->sp", contact.rule[0], PLACED[3].nodes[MESH.faces][..., 2]).max()
    reach = most / PENALTY
    for gap, touches in ((-0.5 * reach, True), (0.5 * reach, True), (1.001 * reach, False)):
        state = contact.evaluate(rest, np.tile([0.0, 0.0, top + gap], (len(INDENTERS), 1)))
        assert state["touched"][3].any() == touches
        assert state["pressure"][3].max() == pytest.approx(max(most - PENALTY * gap, 0.0))
        assert np.abs(state["force"][3]).max() > 0 or not touches


@RUBS
def test_contact_that_is_lifted_off_leaves_nothing_behind(rubs: bool) -> None:
    """Lifted further than the multiplier can close, in the same arrays as the previous contact."""
    contact = Contact(wp.float64, _rubbing(4) if rubs else None, multiplier=_multiplier(4))
    assert contact.evaluate(_displacements())["touched"].any(axis=1).all()
    state = contact.evaluate(_displacements(), TIPS + np.array([0, 0, 1.0]))
    for name in ("touched", "pressure", "force", "traction", "matrix", "energy"):
        assert not state[name].any(), name


@RUBS
def test_an_environment_gets_in_a_batch_of_two_meshes_what_it_gets_alone(rubs: bool) -> None:
    """Bitwise; on the other mesh the result differs."""
    friction = _rubbing(4) if rubs else None
    u = _displacements()
    batched = Contact(wp.float64, friction, multiplier=_multiplier(4)).evaluate(u)
    for mesh in (0, 1):
        one = [mesh] * len(INDENTERS)
        alone = Contact(wp.float64, friction, multiplier=_multiplier(4), variant=one).evaluate(u)
        for env, name in itertools.product(range(len(INDENTERS)), ("force", "pressure", "energy")):
            same = np.array_equal(alone[name][env], batched[name][env])
            assert same == (VARIANT[env] == mesh), name


def test_a_face_rule_integrates() -> None:
    for points in (2, 3, 4):
        shape, weight = face_rule(points)
        assert weight.sum() == pytest.approx(4.0)
        np.testing.assert_allclose(shape.sum(1), 1.0)
        np.testing.assert_allclose(weight @ shape, 1.0)
        # The integral of (N_0)^2 over the square from -1 to 1 is (2/3)^2.
        assert weight @ shape[:, 0] ** 2 == pytest.approx(4 / 9)
