"""Experiments that tell the members of a class of effects apart: the cheapest runs, and the chance that they do."""
