"""`tactile schema`: write the JSON Schema of a kind of file, for editors."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

KINDS = ("bench", "campaign", "sensor")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.description = (
        "Writes the JSON Schema of a kind of YAML file. Editors with a YAML language "
        "server use it for a file that begins with "
        "'# yaml-language-server: $schema=bench.schema.json'."
    )
    parser.add_argument("kind", choices=KINDS, help="kind of file")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="file to write (default: standard output)"
    )


def schema_of(kind: str) -> dict[str, Any]:
    """Return the JSON Schema of files of that kind, one of `KINDS`."""
    if kind == "bench":
        from rig.bench.bench import READER as BENCHES
        from rig.bench.bench import Bench

        return BENCHES.schema(Bench, title="Bench of tactile-rig")
    if kind == "campaign":
        from rig.acquire.campaign import CampaignFile
        from rig.core.config import READER as CAMPAIGNS

        return CAMPAIGNS.schema(CampaignFile, title="Campaign of tactile-rig")
    from sim.sensors.config import READER as SENSORS
    from sim.sensors.sensor import SimulatedSensor

    found = SENSORS.schema(SimulatedSensor, title="Simulated sensor of tactile-rig")
    del found["properties"]["name"]  # a sensor is named as its file is
    return found


def run(options: argparse.Namespace) -> int:
    """Run the command and return the exit code."""
    text = json.dumps(schema_of(options.kind), indent=1) + "\n"
    if options.out is None:
        sys.stdout.write(text)
        return 0
    options.out.write_text(text)
    print(f"{options.out}: written; begin your file with")
    print(f"# yaml-language-server: $schema={options.out.name}")
    return 0
