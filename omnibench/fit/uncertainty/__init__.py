"""Precision with which recordings determine a calibration: covariance, intervals, identifiability."""
