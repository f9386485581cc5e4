"""Evaluation of trained policies: returns, films, and the credit of episodes."""
