"""Zenoh sessions: opening them, access rights, and which robots are present."""
