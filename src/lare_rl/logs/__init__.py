"""Logged episodes: proxy rewards for recorded steps, without a simulator."""
