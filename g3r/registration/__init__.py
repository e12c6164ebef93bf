"""Poses of stacks and slices from the images."""

from g3r.registration.estimate import Registration, register
from g3r.registration.settings import RegistrationSettings

__all__ = ["Registration", "RegistrationSettings", "register"]
