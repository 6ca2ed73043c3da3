"""Export of calibrations to other software, one format in each file."""
