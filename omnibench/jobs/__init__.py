"""Many independent jobs: picklable specifications in, result files in a store out; backends run them."""
