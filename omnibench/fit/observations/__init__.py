"""What is observed of runs: poses, and references of other kinds, as rows of three coordinates."""
