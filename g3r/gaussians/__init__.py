"""3D Gaussians and their renderer."""

from g3r.gaussians.amplitudes import solve_amplitudes
from g3r.gaussians.cloud import GaussianCloud
from g3r.gaussians.overlap import find_overlaps
from g3r.gaussians.render import render

__all__ = ["GaussianCloud", "find_overlaps", "render", "solve_amplitudes"]
