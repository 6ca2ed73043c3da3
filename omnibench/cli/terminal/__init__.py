"""What commands print on a terminal: tables, summaries and progress."""
