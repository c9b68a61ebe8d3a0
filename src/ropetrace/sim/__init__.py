"""Simulated recordings: scenes, a depth camera and its noise."""
