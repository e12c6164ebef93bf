"""The two-stage fit of the Gaussians: to the prior volume (Eq. 8), then to the slices (Eq. 9)."""
