"""How precisely recordings determine a calibration: covariance, intervals, identifiability."""
