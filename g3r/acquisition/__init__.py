"""Input stacks and the model of their acquisition.

docs/architecture.md lists the main modules, and where each equation of the paper is computed.
"""
