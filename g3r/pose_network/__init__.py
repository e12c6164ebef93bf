"""The pose network: a set transformer that puts slices into the atlas frame."""
