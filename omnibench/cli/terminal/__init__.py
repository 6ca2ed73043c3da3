"""Output of commands on a terminal: tables, summaries and progress."""
