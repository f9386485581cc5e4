"""What is to be solved: environments, and the texts that describe them to a language model."""
