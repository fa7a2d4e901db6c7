"""What the pruner learns: where a plan departs from its schedule because of the observation.

``linear`` predicts the effect of every change of a plan, ``switches`` chooses exchanges of cells by it and writes
them into the weights of the pruner, and ``adaptation`` does one after the other and keeps what lowers the error.
"""
