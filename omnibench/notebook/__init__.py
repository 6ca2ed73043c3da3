"""What public objects show in a notebook: texts, data frames and figures."""
