"""How figures are taken, compared and written: the machine, versions, units, points of error and latency."""
