"""The calibrators, one in each file. Importing a module registers its calibrator."""
