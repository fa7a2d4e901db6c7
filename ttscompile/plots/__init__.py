"""Pictures: plans, errors of verification, the frontier of a comparison."""
