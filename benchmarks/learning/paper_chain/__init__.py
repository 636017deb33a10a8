"""The paper's chain and its force net, trained from nothing in minutes, beside simple baselines."""
