"""The importers, one a file. Importing a module registers it."""
