"""Twins of simulated sensors: `python -m benchmarks twin`. In simulation; no real sensor."""

import argparse
from functools import partial
from typing import Literal

from benchmarks.processes import add_processes
from benchmarks.report import Benchmark, Part
from benchmarks.twin import demo, gaugeless, labels, live, skins
from recorder.command_line.options import whole


def _options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--skins", type=whole(1, 1000), default=20, metavar="N", help="of each part (%(default)s)")
    add("--draws", type=whole(1, 1000), default=4, metavar="N", help="of `labels` (%(default)s)")
    add_processes(parser)


def _skins(name: str, title: str, tier: Literal["layer", "fem"] = "layer") -> Part:
    picture, weight = ("skins", 60) if name == "skins" else ("", 300)
    section = partial(skins.section, title, picture=picture)
    return Part(name, partial(skins.measure, tier, name == "planned"), section, weight)


BENCHMARK = Benchmark(
    name="twin",
    title="Twins of sensors, in simulation",
    question="How well does a fit find a skin that is known, do its intervals contain the truth, "
    "and how good are forces and labels by such a twin? No real sensor has been identified: the "
    "skins are simulated.",
    parts=[
        Part("demo", demo.measure, demo.section, weight=20, needs="a mock bench in real time"),
        _skins("skins", "Random skins"),
        _skins("planned", "Presses of a plan of five minutes"),
        _skins("large-strain", "Large strain: truth and correction by `fem`", "fem"),
        Part("gaugeless", gaugeless.measure, gaugeless.section, 100, "a GPU, if complete"),
        Part("labels", labels.measure, labels.section, weight=100),
        Part("live", live.measure, live.section, weight=15),
    ],
    options=_options,
    on_device=True,
)
add_arguments, run = BENCHMARK.add_arguments, BENCHMARK.run
