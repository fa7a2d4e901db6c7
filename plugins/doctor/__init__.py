"""What of this machine, this installation and an artifact stands in the way; with the standard library alone."""
