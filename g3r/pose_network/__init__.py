"""The pose network: a set transformer that predicts slice poses in the atlas frame."""
