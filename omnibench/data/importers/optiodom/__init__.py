"""Importer of the OptiOdom recordings. Importing the package registers it."""

from omnibench.data.importers.optiodom.optiodom import Optiodom

__all__ = ["Optiodom"]
