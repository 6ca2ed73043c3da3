"""Tables of data sets: read, checked, made of runs and turned into runs."""
