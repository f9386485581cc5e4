"""How many candidates a function is made of (line 2 of Algorithm 1 of the LaRe paper).

Apart from `design.py`, so that the command line can say it without what designing needs.
"""

CANDIDATES = 5
"""n of the paper."""

MOST_CANDIDATES = 100
