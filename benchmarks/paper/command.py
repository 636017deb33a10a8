"""The paper's chain trained from nothing, beside simple baselines and the paper's own figures."""

from functools import partial

from benchmarks.paper import chain, full_size, page
from benchmarks.paper.sizes import SIZES
from benchmarks.report import Benchmark, Part

NEEDS = "the extra `diffusion`; a GPU in a complete run"
BENCHMARK = Benchmark(
    "paper",
    "The paper by its own models",
    "Do the paper's two networks, trained from nothing on simulated sensors in minutes, beat "
    "simple baselines on indenters that they never saw, and what does diffusion cost at full size?",
    [
        *(
            Part(part, partial(chain.measure, part), partial(page.section, part), 3, NEEDS)
            for part in SIZES
        ),
        Part("full-size", full_size.measure, full_size.section, 1, "a GPU of 60 GiB"),
    ],
    page.summary,
    on_device=True,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
