"""Importer of CSV tables of any robot. Importing the package registers it."""

from omnibench.data.importers.csv_tables.csv import Csv

__all__ = ["Csv"]
