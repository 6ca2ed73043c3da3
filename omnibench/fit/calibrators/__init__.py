"""The calibrators, one a file. Importing a module registers it."""
