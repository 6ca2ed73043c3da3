"""Queries and orders: a node's query server and its clients."""
