"""Task files: what a task says, when it pays, and which modules it may import."""
