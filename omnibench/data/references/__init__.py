"""References other than poses: distances, turns, displacements, positions and headings of a run."""
