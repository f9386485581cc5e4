"""Adapters of `CreditAssigner` for Gymnasium, Stable-Baselines3, PettingZoo and TorchRL."""
