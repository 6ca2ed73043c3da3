"""Where recordings come from: data sets on disk, importers and simulation."""
