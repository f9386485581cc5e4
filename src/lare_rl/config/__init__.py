"""The settings of a run: their defaults, their validity, and their earlier formats."""
