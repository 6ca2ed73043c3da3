"""Recordings with hidden effects, made without the model's code, to test ``omnibench discover``."""
