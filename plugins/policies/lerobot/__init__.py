"""LeRobot's types of policies: each a module whose ``load`` is given the entries of ``config.json``."""
