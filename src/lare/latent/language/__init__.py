"""The closed language of programs: what is allowed, and how a program is compiled."""
