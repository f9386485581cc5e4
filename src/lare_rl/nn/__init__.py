"""Neural network layers, optimisers and running statistics."""
