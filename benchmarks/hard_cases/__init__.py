"""Hard cases: scenes that break simulators, each checked against laws of mechanics."""
