"""The number of candidates for a function (line 2 of Algorithm 1 of the LaRe paper).

Separate from `design.py`, so that the command line can show it without importing the dependencies of `design.py`.
"""

CANDIDATES = 5
"""n of the paper."""

MOST_CANDIDATES = 100
