"""The closed language: what a program may say, and what becomes of it."""
