"""How pose errors make one number: norms, their weights, and losses that bound the influence of single poses."""
