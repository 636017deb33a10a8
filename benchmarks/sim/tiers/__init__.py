"""The `layer` and `mpm` tiers compared with closed forms and finite elements."""
