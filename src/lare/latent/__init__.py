"""From replies to a function that can be trusted."""
