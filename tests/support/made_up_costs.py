"""Cost tables and timed presses that follow known laws, for tests of the planner."""

import math

import numpy as np

from benchmarks.sim.cost_table.measure import conditions_text
from sim.planner.error_model import CostRow, Table
from sim.planner.features import GROUPS, KINDS, Choice, Features
from sim.planner.seconds import Timed

MESHES = (3, 4, 5, 6)


def drawn(random, group):
    """Features of a made-up scene of a group."""
    contact = math.exp(random.uniform(-2.5, 0.3))
    smooth = "smooth" in group
    return Features(
        depth=random.uniform(0.05, 0.45),
        contact=contact,
        contact_least=contact * random.uniform(0.4, 1.0),
        sharpest=contact * random.uniform(0.7, 2) if smooth else contact * random.uniform(0.1, 0.5),
        poisson=random.uniform(0.8, 4.0),
        friction=random.uniform(0, 1),
        shear=random.uniform(0.05, 0.4) if "shear" in group else 0.0,
        side=random.uniform(0.0, 0.9),
        viscous=random.uniform(0.1, 1.0) if group == "viscous" else 0.0,
        width=random.uniform(2, 6),
        steps=random.uniform(2, 40),
    )


def made_up(seed, scenes, unsolved=0.0):
    """A table whose errors follow a law with a spread of a factor of about 1.5."""
    random = np.random.default_rng(seed)
    rows = []
    for index in range(scenes):
        features = drawn(random, GROUPS[index % len(GROUPS)])
        base = 0.3 * features.depth**0.5 * math.exp(0.3 * random.normal())
        for choice in (Choice("layer"), *(Choice("fem", cells) for cells in MESHES)):
            error = base * math.exp(0.3 * random.normal())
            if choice.tier == "fem":
                error *= (1 / choice.cells / features.contact_least) ** 1.5 / 3
            bar = 0.7 * error * math.exp(0.2 * random.normal())
            if random.random() < unsolved:
                error = math.inf
            work = {"elements": 20.0 * choice.cells**3 + 1, "newton": 5 * features.steps, "cg": 0.0}
            work["cg"] = work["newton"] * (10 + 3 * choice.cells)
            rows.append(
                CostRow(f"made-up-{seed}-{index}", "none", features, choice, work,
                        dict.fromkeys(KINDS, error), dict.fromkeys(KINDS, bar))
            )  # fmt: skip
    return Table({"scenes": f"made-up, seed {seed}", "numerics": conditions_text()}, tuple(rows))


def timed_presses():
    found = [Timed("cpu", "m", Choice("layer"), 16384, n, 0, 4, 0.01 + 2e-3 * n) for n in (5, 20)]
    for precision, factor in (("float32", 1.0), ("float64", 1.3)):
        for cells in (3, 4, 6, 8):
            elements, newton, cg = 20.0 * cells**3, 30.0, 30 * (10.0 + 3 * cells)
            seconds = factor * (0.05 + 1e-4 * newton + 1e-6 * elements * cg)
            choice = Choice("fem", cells, precision)
            found.append(Timed("cpu", "m", choice, elements, newton, cg, 4, seconds))
    return found
