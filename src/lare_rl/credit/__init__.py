"""Return decomposition: pure functions on episodes."""
