"""Preservation of lesions by the prior (docs/prior.md)."""
