"""The paper's protocol with this code, baselines and other programs on the same subjects: docs/paper.md."""
