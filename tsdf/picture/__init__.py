"""Scenes made ready, rendered, and written as images."""
