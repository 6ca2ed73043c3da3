"""Load and faults on the live system's processes, and an account of every sample."""
