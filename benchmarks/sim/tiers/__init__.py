"""The `layer` and `mpm` tiers beside closed forms and finite elements."""
