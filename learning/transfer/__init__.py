"""Forces on a sensor that has no gauge, from a recording of another sensor that has one.

`learning.transfer.run.run_transfer` goes through the stages. Presses of both sensors are matched by
place and split (`pairs`). An experiment trains the translator and the force models
(`learning.experiment`). The model learns the target's own frames, and errors on indenters that no
model saw become intervals (`by_place`). Labels or weights set the scale (`scale`), and the model is
written with its card and report (`deliver`).
"""
