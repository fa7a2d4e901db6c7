"""The sparse call as a straight line of torch's operations, on any device that torch has."""
