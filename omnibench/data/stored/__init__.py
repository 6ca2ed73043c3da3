"""Data sets larger than memory: runs whose samples are read where they are used."""
