"""The tables of the reference pages, from the code."""
