"""Kernels: how light walks through media, level by level."""
