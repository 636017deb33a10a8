"""JSON Schemas of the files of a lab, for editors: `tactile init` writes them."""

from __future__ import annotations

from typing import Any

KINDS = ("bench", "campaign", "sensor")


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

    schema = SENSORS.schema(SimulatedSensor, title="Simulated sensor of tactile-rig")
    del schema["properties"]["name"]  # a sensor is named as its file is
    return schema
