"""Cost of accuracy in time: errors, times, tolerances and effects of the simulator."""
