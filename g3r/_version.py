"""Version of g3r, read by the build and written into every output."""

__version__ = "0.2.0"
