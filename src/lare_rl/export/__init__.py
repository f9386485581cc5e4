"""Export of policies and rewards to ONNX and NumPy, for programs without LaRe and JAX."""
