"""The checks that a program must pass before it is used."""
