"""Hard cases: scenes that break simulators, each held to laws of mechanics."""
