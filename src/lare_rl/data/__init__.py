"""Experience: trajectories, the replay that stores them, and the samples that an update reads."""
