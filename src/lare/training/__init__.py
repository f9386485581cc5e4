"""How a run trains: steps are collected, credited and learned from."""
