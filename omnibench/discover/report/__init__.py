"""The HTML report of a discovery."""
