"""Calibration and check of the stated uncertainty against the error (docs/prior.md)."""
