"""Worlds with ground truth: SAPIEN-rendered trajectories and a numpy toy world."""
