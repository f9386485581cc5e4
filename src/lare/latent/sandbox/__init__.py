"""Where a program runs: a process without rights, and its other end."""
