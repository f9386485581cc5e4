"""Tasks: environments, and the texts that describe them to a language model."""
