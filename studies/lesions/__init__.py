"""Whether lesions survive the prior (docs/prior.md)."""
