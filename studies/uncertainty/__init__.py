"""Stated uncertainty against error: calibration and check (docs/prior.md)."""
