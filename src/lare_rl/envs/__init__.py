"""Environments: one interface, and one file for each family."""
