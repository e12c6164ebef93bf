"""Accuracy of registration: the tables of docs/motion.md."""
