"""What learns: each module proposes plans, and the judge says how good they are (``calibration.proposer``)."""
