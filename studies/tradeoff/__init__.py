"""Time, memory and number of Gaussians against accuracy: docs/tradeoff.md."""
