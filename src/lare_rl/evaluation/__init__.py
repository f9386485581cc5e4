"""Evaluation of trained policies: returns, films, and credit of new episodes."""
