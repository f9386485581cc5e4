"""The sandbox: the process without rights in which a program runs, and the parent's side of it."""
