"""Logs of the past: proxy rewards for episodes that somebody recorded, without a simulator."""
