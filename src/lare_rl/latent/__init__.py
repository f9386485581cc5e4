"""From replies of a language model to a verified function."""
