"""Recordings in which something is hidden: the exam of ``omnibench discover``, made without any of the model's code."""
