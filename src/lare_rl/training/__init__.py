"""The training of a run: steps are collected, given credit and learned from."""
