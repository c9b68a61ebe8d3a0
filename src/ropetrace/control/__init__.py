"""Guiding a robot arm along the rope (section 5.2)."""
