"""What was met: trajectories, the replay that holds them, and which of it an update reads."""
