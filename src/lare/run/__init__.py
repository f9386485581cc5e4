"""A run: its settings, and what it leaves on the disk."""
