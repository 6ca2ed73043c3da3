"""Zenoh sessions: how they are opened, who may do what, who is there."""
