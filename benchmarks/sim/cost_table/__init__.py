"""What errors cost on random scenes: the table that the planner reads."""
