"""Task files: what a task says, and how it is read."""
