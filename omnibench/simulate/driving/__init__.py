"""Commands that a robot can drive, with their durations, and runs of them as designed."""
