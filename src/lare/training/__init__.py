"""A run: replay, the fused training step, checkpoints."""
