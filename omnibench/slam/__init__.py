"""Reference poses from laser scans: each is matched against a map that grows with them.

The search for a pose starts from the odometry or from the last pose. The path begins at the run's start pose, or, when
the first scan comes later, where the odometry has led by then.
"""
