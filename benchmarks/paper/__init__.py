"""`lare-rl reproduce`: the figures and tables of the LaRe paper, from new runs."""
