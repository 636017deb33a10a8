"""The paper's states on the default mesh: presses of a bonded, nearly incompressible layer."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from support.simulated_archives import make

from recorder import MarkerArchive
from recorder.archive import ArchivedSensor
from recorder.markers import HEIGHT, WIDTH
from sim.dataset import DatasetPlan, gel

# Indenters, and the outward motion of the surface 6 to 9 mm from a press 1.5 mm deep [mm]; the
# small one displaces less.
SPHERES = {"sphere": (0.09, 0.18), "sphere_s": (0.05, 0.18)}
SYMMETRIC = ("sphere", "sphere_s", "cylinder_sh")


@pytest.fixture(scope="module")
def states(tmp_path_factory: pytest.TempPathFactory) -> MarkerArchive:
    path = tmp_path_factory.mktemp("states") / "states.markers.zarr"
    make(path, DatasetPlan("states", (gel(("Array1",)),), SYMMETRIC))
    archive = MarkerArchive(path)
    assert archive.warning is None
    return archive


def deepest_in_the_middle(archive: MarkerArchive, indenter: str) -> int:
    table = archive["Array1"].table
    central = (np.abs(table["position"]) < 1e-9).all(axis=1)
    of = table["indenter"] == archive.indenters.index(indenter)
    (row,) = np.flatnonzero(of & central & np.isclose(table["depth"], 1.5e-3))
    return int(row)


def outwards(sensor: ArchivedSensor, row: int) -> NDArray[np.float64]:
    """Return the motion of the surface away from the centre, 6 to 9 mm from it [mm]."""
    columns, rows = np.meshgrid(sensor.lattice.columns, sensor.lattice.rows)
    x, y = columns - (WIDTH - 1) / 2, rows - (HEIGHT - 1) / 2
    radius = np.hypot(x, y)
    moved = sensor.displacement([row])[0].astype(float)
    along = (moved[..., 0] * x + moved[..., 1] * y) / np.maximum(radius, 1.0)
    ring = (radius * sensor.mm_per_px >= 6.0) & (radius * sensor.mm_per_px < 9.0)
    return along[ring & np.isfinite(along)] * sensor.mm_per_px


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("indenter", SPHERES)
def test_beside_a_sphere_the_skin_moves_outwards(states: MarkerArchive, indenter: str) -> None:
    least, most = SPHERES[indenter]
    found = outwards(states["Array1"], deepest_in_the_middle(states, indenter))
    assert len(found) > 500
    assert least < found.mean() < most
    assert found.min() > 0


@pytest.mark.slow
@pytest.mark.timeout(900)
@pytest.mark.parametrize("indenter", SYMMETRIC)
def test_symmetric_indenters_give_mirror_images_within_a_pixel(
    states: MarkerArchive, indenter: str
) -> None:
    (mask,) = states["Array1"].masks([deepest_in_the_middle(states, indenter)])
    assert (mask ^ states["Array1"].reference(0)).sum() > 100
    for mirrored in (mask[:, ::-1], mask[::-1]):
        assert not (mask & ~binary_dilation(mirrored, np.ones((3, 3)))).any()
