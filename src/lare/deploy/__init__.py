"""A run's policy and rewards for programs that have neither LaRe nor JAX: ONNX, and NumPy arrays."""
