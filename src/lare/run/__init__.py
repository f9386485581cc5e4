"""A run: its settings, and its files on the disk."""
