"""The check of a recording: is it fit for calibration, what is wrong with it, and what to type."""
