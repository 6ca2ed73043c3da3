"""The motions that a calibration was fitted to, and what holds outside them."""
