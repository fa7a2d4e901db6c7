"""The definition of every runtime: reuse executed literally, with torch. Nothing of this is on the robot."""
