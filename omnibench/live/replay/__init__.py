"""Recordings played onto Zenoh as a robot would send them."""
