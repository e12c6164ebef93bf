"""Planning of a run: settings by name, time budgets, and memory stated before it is taken."""

PRESET_NAMES = ("preview", "fast", "balanced", "accurate")
"""Keys of `presets.PRESETS`, here so that a command's help need not import torch."""
