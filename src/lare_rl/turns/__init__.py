"""Credit for the turns of agents that talk: a value of prefixes in closed form, from outcomes alone. NumPy only."""
