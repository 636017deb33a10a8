"""Material compensation: scaling labels of one skin to the stiffness of another (eq. 7 to 9).

A prior is the force with which a flat indenter presses a sensor to a given depth. The ratio of two
priors scales the labels on which a force model of the target is trained.
"""
