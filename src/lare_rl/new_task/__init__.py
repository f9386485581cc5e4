"""Drafts of task files: `lare-rl new-task`."""
